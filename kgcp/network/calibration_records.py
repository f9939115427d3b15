"""Settings, input and result of a calibration."""

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
    """How the adjustment treats the field's coordinates."""

    FIXED = "fixed"  # held as stated
    STIFF = "stiff"  # estimated with the stated standard deviations
    FREE = "free"  # estimated from the photographs, but for shift, rotation and scale


class LensModel(StrEnum):
    """Distortion terms that are estimated."""

    AUTO = "auto"  # those that are significant
    RADIAL = "radial"
    BROWN = "brown"
    RATIONAL = "rational"


@dataclass(frozen=True, slots=True)
class CalibrationSettings:
    """Choice of the unknowns."""

    points: PointModel = PointModel.STIFF
    lens: LensModel = LensModel.AUTO
    # whether fx = fy; None: `LensModel.AUTO` decides by significance, other models take them equal
    is_same_aspect: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NamedView:
    """The measured and identified discs of one photograph."""

    photo: str
    point: IndexArray  # (k,): index of each disc in the field
    vectors: FloatArray  # (k, 5): centroid and second moments, as kgcp.measurement.discs.MOMENTS
    covs: FloatArray  # (k, 5, 5)
    # whether the field looks the same here after half a turn or a quarter turn
    is_symmetric: bool


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera with its covariance and the adjustment that it comes from."""

    camera: Camera
    covariance: CalibrationCovariance
    field: AnyField  # with the diameters that were used
    settings: CalibrationSettings
    views: tuple[NamedView, ...]  # those that took part
    dropped: tuple[str, ...]  # photographs that fit neither the field nor the others
    network: Network
    solution: Solution
    precision: Precision
    eccentricity: Eccentricity  # of every disc, in the order of the observations
    points_used: PointModel  # FIXED if the field's shape cannot be estimated
    rms_fixed_px: float  # per point, with the field as stated
    radius_scale: float  # measured over stated radii: median
    radius_scales: FloatArray  # (v,): the same for each photograph
    # distortion terms that are not significant, estimated with priors of usual lenses
    insignificant: tuple[str, ...]
    undetermined: tuple[str, ...]  # camera parameters that these photographs do not determine
    tangled: tuple[str, ...]  # camera parameters that cannot be separated
    # whether a symmetric field may have been turned between photographs without this being noticed
    is_turn_unclear: bool

    @property
    def rms_px(self) -> float:
        """RMS of the residuals per point, √mean(dx² + dy²) [px]."""
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
    def misfit_px(self) -> float:
        """RMS per point of the residuals of `comparable_residuals` [px]."""
        return misfit_px(self.views, self.solution)

    @property
    def operator_sd_px(self) -> float:
        """Median standard deviation per point that the disc operator states [px]."""
        return operator_sd_px(self.views)


def operator_sd_px(views: Sequence[NamedView]) -> float:
    """Return the median standard deviation per point that the disc operator states [px]."""
    return float(np.median(_stated_sds_px(views)))


def _stated_sds_px(views: Sequence[NamedView]) -> FloatArray:
    covs = np.concatenate([view.covs[:, :2, :2] for view in views])
    return np.asarray(np.sqrt(np.trace(covs, axis1=1, axis2=2)))


def comparable_residuals(views: Sequence[NamedView], solution: Solution) -> FloatArray:
    """Return residuals (n, 2) that can be compared with `operator_sd_px` [px].

    Discs that are covered in part or crossed by a shadow are measured 10 to 100 times worse than
    others. Their residuals are divided by the ratio of their stated standard deviation to the
    median one: a few of them must not make a calibration look bad. The residuals of discs that are
    measured better than most remain as they are, because errors of the model affect all alike.
    """
    sds_px = _stated_sds_px(views)
    share = np.minimum(1.0, np.median(sds_px) / sds_px)
    return np.asarray(solution.residuals * share[:, None])


def misfit_px(views: Sequence[NamedView], solution: Solution) -> float:
    """Return the RMS per point of the residuals of `comparable_residuals` over kept discs [px]."""
    squares = np.sum(comparable_residuals(views, solution)[solution.is_used] ** 2, axis=1)
    return float(np.sqrt(squares.mean()))


def rms_px(solution: Solution) -> float:
    """Return √mean(dx² + dy²) over the kept discs [px]."""
    squares = np.sum(solution.residuals[solution.is_used] ** 2, axis=1)
    return float(np.sqrt(squares.mean()))
