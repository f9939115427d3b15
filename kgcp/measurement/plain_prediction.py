"""Where a static target must be in a frame; of a plain one, how large, and how its plane lies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.measurement.plate_prior import NormalPrior, SceneRotation
from kgcp.targets.plain import PlainTarget

SIGMAS = 4.0
"""How many standard deviations a target may be off its prediction."""
SMALLEST_PX, SMALLEST_BARE_PX, SMALLEST_FREE_PX = 2.5, 3.0, 4.0
"""Least radius of plain targets: on even ground of their own, without it, and with a free normal.

Below, pebbles and clods are as round (`benchmarks.ground.plain_targets`). On ground that is not
known to be even, one disc in sixty was measured at a wrong place at 2.5 px. With a free normal, any
ellipse is accepted: between 2.5 and 4 px, three or more of 2000 places without a target were taken
for one.
"""
_FARTHEST = 16.0  # largest reach in radii that is searched
_FREE_SD_DEG = 60.0  # prior of a free normal about the viewing ray
_LEAST_COSINE = 0.17  # of the angle between normal and ray: 80°


@dataclass(frozen=True, slots=True, eq=False)
class PredictedPlace:
    """Where a static target must be in a frame."""

    # (2,): projected centre [px]; NaN: behind the camera, or where its distortion does not hold
    centre_px: FloatArray
    cov_px2: FloatArray  # (2, 2): its covariance [px²]
    radius_px: float  # largest radius of its outer circle [px]

    def contradiction_px(
        self, place_px: FloatArray, sd_px: float = 0.0, sigmas: float = SIGMAS
    ) -> float | None:
        """Return how far off the target's place is, if this contradicts the prediction [px].

        None: the standard deviations explain it. Infinite: it should not be seen at all.

        Parameters
        ----------
        sd_px : float
            Standard deviation of either coordinate of that place [px].
        sigmas : float
            How many standard deviations it may be off.
        """
        if np.isnan(self.centre_px).any():
            return math.inf if _is_sure(self.cov_px2, self.radius_px) else None
        off_px = place_px - self.centre_px
        cov_px2 = self.cov_px2 + sd_px**2 * np.eye(2)
        is_far = float(off_px @ np.linalg.solve(cov_px2, off_px)) > sigmas**2
        return float(np.linalg.norm(off_px)) if is_far else None


@dataclass(frozen=True, slots=True, eq=False)
class PlainPrediction:
    """The image of a plain target, predicted from its position and the frame's orientation.

    Attributes
    ----------
    centre_px : (2,) array
        Projected centre [px]; NaN as in `PredictedPlace`.
    cov_px2 : (2, 2) array
        Covariance of the centre [px²].
    position_m : (3,) array
        Its centre in the camera frame [m].
    sd_log_distance : float
        Standard deviation of the logarithm of its distance.
    normal : NormalPrior or None
        Direction of its normal; None: not known.
    radius_px : float
        Largest radius of its outer circle [px].
    source : str
        What it was made from, in a few words.
    rotation : SceneRotation or None
        How the scene turns during the readout; None: not known.
    """

    centre_px: FloatArray
    cov_px2: FloatArray
    position_m: FloatArray
    sd_log_distance: float
    normal: NormalPrior | None
    radius_px: float
    source: str
    rotation: SceneRotation | None = None

    def __str__(self) -> str:
        """Text for the detail of a row."""
        x, y = self.centre_px
        if math.isnan(x):
            where = "behind the camera" if self.position_m[2] <= 0.0 else "far aside"
            return f"expected by {self.source} {where}"
        return (
            f"expected by {self.source} at ({x:.0f}, {y:.0f}) ± {self.sd_px:.1f} px, radius"
            f" {self.radius_px:.1f} px"
        )

    @property
    def prior(self) -> NormalPrior:
        """The normal, for an adjustment.

        A free normal is taken to be roughly along the viewing ray, since the target is seen. This
        weak prior only keeps equations regular if a circle is seen frontally.
        """
        if self.normal is not None:
            return self.normal
        return NormalPrior(self.position_m / np.linalg.norm(self.position_m), _FREE_SD_DEG)

    @property
    def sd_px(self) -> float:
        """Largest standard deviation of the centre over all directions [px]."""
        return _sd_px(self.cov_px2)

    @property
    def reach_px(self) -> float:
        """How far the centre may be from its prediction [px]."""
        return SIGMAS * self.sd_px

    @property
    def is_sure(self) -> bool:
        """Whether it is certain enough to look there."""
        return _is_sure(self.cov_px2, self.radius_px)

    def is_from_behind(self) -> bool:
        """Tell whether its plane turns away from the camera, or is seen edge on."""
        if self.normal is None:
            return False
        along = self.position_m / np.linalg.norm(self.position_m)
        return bool(along @ self.normal.direction_camera < _LEAST_COSINE)

    def is_outside(self, camera: Camera) -> bool:
        """Tell whether no part of the target can be in the frame."""
        x, y = self.centre_px
        if math.isnan(x):
            return self.is_sure
        reach = self.radius_px + self.reach_px
        return bool(max(-x, x - camera.width + 1.0, -y, y - camera.height + 1.0) > reach)

    def is_inside(self, camera: Camera) -> bool:
        """Tell whether the whole target is predicted inside the frame."""
        x, y = self.centre_px
        margin = min(x, camera.width - 1.0 - x, y, camera.height - 1.0 - y)
        return bool(margin >= self.radius_px)


def _sd_px(cov_px2: FloatArray) -> float:
    return math.sqrt(float(np.linalg.eigvalsh(cov_px2)[-1]))


def _is_sure(cov_px2: FloatArray, radius_px: float) -> bool:
    return SIGMAS * _sd_px(cov_px2) <= _FARTHEST * radius_px


def smallest_radius_px(target: PlainTarget) -> float:
    """Return the least radius at which a plain target is looked for [px]."""
    if target.normal_enu is None:
        return SMALLEST_FREE_PX
    return SMALLEST_BARE_PX if target.border_m is None else SMALLEST_PX
