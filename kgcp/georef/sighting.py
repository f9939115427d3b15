"""One measured target: the part of the measurement that georeferencing needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import CircleImage, Measurement

_MAX_HEADING_VARIANCE_RAD2 = 1.0  # with a larger one, the heading counts as unknown

CAMERA_SPEED_M_S = 10.0
"""Assumed speed of the camera while a rolling shutter reads the frame, if it is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One target measured in one frame."""

    frame: str  # path relative to the frames folder
    number: int  # position of the frame among all frames of the flight, from 1
    target: str  # name in flight.toml
    instance: int  # 0 for the best plate with this code in the frame
    time_s: float | None  # mid-exposure, Unix UTC [s]; None: not known
    centre_px: FloatArray  # (2,): projected circle centre in the raw image [px]
    centre_cov_px2: FloatArray | None  # (2, 2): its covariance [px²]
    distance_m: float  # projection centre to target centre [m]
    sd_distance_m: float | None  # its standard deviation [m]
    # share of calibration and diameter [m]: an error that all frames share, not included in
    # `sd_distance_m`
    sd_common_distance_m: float | None
    pose: Pose | None = None  # target → camera; None: not measured
    # (6, 6): its covariance: translation [m], left rotation vector in the camera frame [rad]
    pose_cov: FloatArray | None = None
    score: float | None = None  # normalised cross-correlation of the code
    ambiguity: float | None = None  # Δχ² by which the circle's other pose is worse
    # (6, 6): share of calibration and diameter, not included in `pose_cov`; None: not known
    common_pose_cov: FloatArray | None = None
    image: CircleImage | None = None  # of a plain target's outer circle, without any prior
    inner_growth: float | None = None  # as in `Appearance`
    dots_growth: float | None = None

    @property
    def has_heading(self) -> bool:
        """Whether the target's rotation in its plane is known; a plain disc shows none."""
        if self.pose is None or self.pose_cov is None:
            return False
        normal = self.pose.normal
        return bool(normal @ self.pose_cov[3:, 3:] @ normal < _MAX_HEADING_VARIANCE_RAD2)

    def row_time_s(self, camera: Camera) -> float | None:
        """Return when the centre's row was exposed, Unix UTC [s].

        A rolling shutter reads from the first to the last row in `camera.readout_s`; the frame's
        time is that of the middle row.
        """
        if self.time_s is None:
            return None
        return self.time_s + self.delay_s(camera)

    def delay_s(self, camera: Camera) -> float:
        """Return how much later than the middle row the centre's row was exposed [s]."""
        return self.rows_since_middle(camera) * camera.readout_s

    def rows_since_middle(self, camera: Camera) -> float:
        """Return how far below the middle row the centre is, in frame heights; inside ±0.5."""
        return float(camera.rows_since_middle(self.centre_px[None])[0])


def sighting_of(
    frame: str, number: int, time_s: float | None, measurement: Measurement
) -> Sighting:
    """Return the part of a measurement that georeferencing needs.

    Parameters
    ----------
    number : int
        Position of the frame among all frames of the flight, from 1.
    """
    own, common = measurement.uncertainty, measurement.common
    return Sighting(
        frame=frame,
        number=number,
        target=measurement.target,
        instance=measurement.instance,
        time_s=time_s,
        centre_px=measurement.centre_px,
        centre_cov_px2=None if own is None else own.centre_cov_px2,
        distance_m=measurement.distance_m,
        sd_distance_m=None if own is None else own.sd_distance_m,
        sd_common_distance_m=None if common is None else common.sd_distance_m,
        pose=measurement.pose,
        pose_cov=None if own is None else own.pose_cov,
        score=measurement.score,
        ambiguity=None if measurement.alternative is None else measurement.alternative.ambiguity,
        common_pose_cov=None if common is None else common.pose_cov,
        image=measurement.image,
        inner_growth=measurement.appearance.inner_growth,
        dots_growth=measurement.appearance.dots_growth,
    )


def unmistakable(sightings: Sequence[Sighting]) -> list[Sighting]:
    """Return the sightings in frames that show one plate with the target's code.

    If there are several, the frame does not tell which is the target: the best score may be that of
    another vehicle's plate, or of a spare one.
    """
    several = {(each.frame, each.target) for each in sightings if each.instance}
    return [each for each in sightings if (each.frame, each.target) not in several]


@dataclass(frozen=True, slots=True)
class Exposure:
    """What may displace edges, named as the columns of the detections; None: null there."""

    radius_px: float | None
    blur_px: float | None
    edge_shift_px: float | None
    black: float | None
    white: float | None
    saturated: float | None
    exposure_time_s: float | None
    iso: float | None
    f_number: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """The search for one target in one readable frame, with its result."""

    # as in the detections
    frame: str
    target: str
    time_s: float | None  # mid-exposure, Unix UTC [s]
    sighting: Sighting | None  # None where the target was not measured
    exposure: Exposure


def known_times_s(attempts: Sequence[Attempt]) -> dict[str, float]:
    """Return the mid-exposures of frames [s]; those without a time are left out."""
    return {each.frame: each.time_s for each in attempts if each.time_s is not None}
