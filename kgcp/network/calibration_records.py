"""What a calibration is asked for, what it is made from, and what it returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Eccentricity
from kgcp.network.records import Network, Precision, Solution
from kgcp.targets.fields.points import AnyField


class PointModel(StrEnum):
    """What the adjustment may do to the field's own coordinates."""

    FIXED = "fixed"  # nothing
    STIFF = "stiff"  # move them as far as `Field.flat_sd_m` says
    FREE = "free"  # estimate them, up to shift, turn and scale


class LensModel(StrEnum):
    """Which terms of distortion are estimated."""

    AUTO = "auto"  # as many as are significant
    RADIAL = "radial"
    BROWN = "brown"
    RATIONAL = "rational"


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """What is estimated."""

    points: PointModel = PointModel.STIFF
    lens: LensModel = LensModel.AUTO
    # whether fx and fy are one; None: two where that is significant, with `LensModel.AUTO`
    is_same_aspect: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NamedView:
    """The measured discs of one photograph, and which of the field's they are."""

    photo: str
    point: IndexArray  # (k,)
    vectors: FloatArray  # (k, 5): centroid and second moments, as kgcp.measurement.discs.MOMENTS
    covs: FloatArray  # (k, 5, 5)
    # whether the field could lie there turned by half a turn, or by quarters: it looks the same
    is_symmetric: bool


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera, how well it is known, and everything that was adjusted with it."""

    camera: Camera
    covariance: CalibrationCovariance
    field: AnyField  # with the diameters that were used
    settings: CalibrationSettings
    views: tuple[NamedView, ...]  # those that took part
    dropped: tuple[str, ...]  # photographs that do not fit the field or the others
    network: Network
    solution: Solution
    precision: Precision
    eccentricity: Eccentricity  # of every disc, in the order of the observations
    points_used: PointModel  # fixed where the field's own shape cannot be estimated
    rms_fixed_px: float  # per point, with the field as it is meant to be
    radius_scale: float  # seen over stated radii
    radius_scales: FloatArray  # (v,): the same of each photograph
    undetermined: tuple[str, ...]  # camera parameters that these photographs do not determine
    tangled: tuple[str, ...]  # camera parameters that cannot be told apart
    is_turn_unclear: bool  # whether a symmetric field may be turned between photographs

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per point, √mean(dx² + dy²) [px]."""
        return rms_px(self.solution)

    @property
    def bar_residuals_m(self) -> tuple[float, ...]:
        """Measured minus adjusted length of each of the field's bars [m]."""
        place_of = dict(zip(self.field.names(), self.solution.estimate.points, strict=True))
        return tuple(
            bar.length_m - float(np.linalg.norm(place_of[bar.second] - place_of[bar.first]))
            for bar in self.field.bars
        )

    @property
    def operator_sd_px(self) -> float:
        """Median of the discs' own deviations per point, as the operator states them [px]."""
        return operator_sd_px(self.views)


def operator_sd_px(views: Sequence[NamedView]) -> float:
    """Return the median of the discs' deviations per point, as the operator states them [px]."""
    covs = np.concatenate([view.covs[:, :2, :2] for view in views])
    return float(np.median(np.sqrt(np.trace(covs, axis1=1, axis2=2))))


def rms_px(solution: Solution) -> float:
    """Return √mean(dx² + dy²) of the discs that were kept [px]."""
    squares = np.sum(solution.residuals[solution.is_used] ** 2, axis=1)
    return float(np.sqrt(squares.mean()))
