"""The records of a measurement: what one frame shows of its targets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.errors import Reason, Status
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose


@dataclass(frozen=True, slots=True)
class Appearance:
    """What the image looked like at the target.

    Attributes
    ----------
    radius_px : float
        Semi-major axis of the main ring's outer ellipse [px].
    black, white : float
        Levels of ink and plate, 0…1 of the grey values' range.
    saturated : float
        Share of clipped pixels within the outer ellipse, 0…1.
    edge_shift_px : float or None
        δ: displacement of the edges towards the dark side, from both circles [px]; None where the
        method does not estimate it.
    blur_px : float or None
        Edge spread σ [px]; None where the method does not estimate it.
    inner_growth : float or None
        By how much the image shows the main ring's inner circle larger than the layout, relative
        to the outer one, as a share; None where the method does not estimate it.
    dots_growth : float or None
        The same for the code: the circle through the dots' centres, and the dots, relative to the
        ring.
    """

    radius_px: float
    black: float
    white: float
    saturated: float
    edge_shift_px: float | None = None
    blur_px: float | None = None
    inner_growth: float | None = None
    dots_growth: float | None = None


class ToneBase(StrEnum):
    """The known curve that a fitted tone curve is a modification of."""

    SRGB = "sRGB"
    LINE = "a straight line"


@dataclass(frozen=True, slots=True)
class Imaging:
    """What the fit of one target shows of the camera. Grey values are 0…1 of their range.

    Attributes
    ----------
    base : ToneBase
        The known curve that the tone curve is near to.
    black, white : float
        Light of ink and plate, as the grey values that the base would give them.
    tone : tuple of float
        Three shape parameters of the curve between ink and plate, as in `photometry.Light`.
    sharpening : float
        Strength of the unsharp mask.
    noise_black, noise_white : float
        Standard deviation of the grey values of ink and plate.
    """

    base: ToneBase
    black: float
    white: float
    tone: tuple[float, float, float]
    sharpening: float
    noise_black: float
    noise_white: float


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Covariances of one measurement.

    Attributes
    ----------
    pose_cov : (6, 6) array
        Order tx ty tz [m], rotation vector x y z [rad], left perturbation in the camera frame.
    centre_cov_px2 : (2, 2) array
        Of the projected centre [px²].
    sd_distance_m : float
        Of the distance [m].
    sd_roll_deg, sd_pitch_deg, sd_heading_deg : float
        Of the three reported angles [deg].
    """

    pose_cov: FloatArray
    centre_cov_px2: FloatArray
    sd_distance_m: float
    sd_roll_deg: float
    sd_pitch_deg: float
    sd_heading_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class CommonUncertainty:
    """Errors that all frames share, by camera calibration and diameter; not in `Uncertainty`.

    Attributes
    ----------
    pose_cov : (6, 6) array
        As in `Uncertainty`.
    sd_distance_m : float
        Of the distance [m].
    sd_direction_mrad : float
        Largest one of the direction to the target's centre in the camera frame [mrad].
    """

    pose_cov: FloatArray
    sd_distance_m: float
    sd_direction_mrad: float


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """The other pose of the circle.

    Attributes
    ----------
    pose : Pose
        It has nearly the same distance; its normal is mirrored about the viewing ray.
    ambiguity : float
        How much worse it fits; 0: it fits as well. With the image model: Δχ² of the image, divided
        by the inflation of the covariance, plus that of the prior. With the paper's chain: misfit
        of the inner ellipse's centre [px].
    pose_cov : (6, 6) array or None
        As in `Uncertainty`, if this were the right pose; None if the image clearly excludes it.
    """

    pose: Pose
    ambiguity: float
    pose_cov: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ContourSmoothing:
    """Effect on a measurement of smoothing along contours beyond the blur across them.

    Attributes
    ----------
    seen_px2, sd_seen_px2 : float
        The smoothing, as a variance, that this image alone shows, and its standard deviation [px²].
    pose_by_smoothing : (6,) array
        Derivative of the pose, in the order of `Uncertainty.pose_cov` [m/px², rad/px²].
    taken_px2, sd_taken_px2 : float
        The smoothing, and its standard deviation, that pose and covariance are corrected for [px²].
    """

    seen_px2: float
    sd_seen_px2: float
    pose_by_smoothing: FloatArray
    taken_px2: float = 0.0
    sd_taken_px2: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """The start of the adjustment: a pose, from the outline that the search has followed."""

    ring: str  # name of the ring, the target's own or a replica
    score: float  # normalised cross-correlation of the code
    pose: Pose  # target → camera; good to a per cent or two
    radius_px: float  # semi-major axis of the main ring's outer ellipse [px]
    # δ: displacement of the edges towards the dark side, from both circles [px]
    edge_shift_px: float
    blur_px: float  # edge spread σ [px]


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One measured target.

    Attributes
    ----------
    target, ring : str
        Name of the target, and of the ring (itself or a replica) that was measured.
    instance : int
        0, 1, … in order of score among plates of the same code in the frame.
    score : float
        Normalised cross-correlation of the code; NaN of a target without one.
    pose : Pose
        Target → camera.
    centre_px : (2,) array
        Projected circle centre in the raw image [px].
    heading_deg : float
        In-image direction of the target's +x axis, clockwise from image x [deg].
    alternative : Alternative or None
        None where the two poses coincide.
    uncertainty : Uncertainty or None
        None where the method gives none.
    common : CommonUncertainty or None
        None where nothing is known about calibration and diameter.
    is_guided : bool
        Whether it was found only with a prediction from other frames or the reference poses.
    imaging : Imaging or None
        None where the method fits no tone.
    rival : RivalTone or None
        The measurement over the other base of an unknown tone; None if that was not tried, or
        failed.
    smoothing : ContourSmoothing or None
        None where none is expected: with a known tone, and in bins.
    eccentricity_px : (2,) array or None
        Centroid of the image of the main ring's outer circle minus `centre_px`: the error of
        programs that measure the centroid. None where it was not asked for.
    image : CircleImage or None
        Image of a plain target's outer circle, which its pose was made from; None for coded rings.
    """

    target: str
    ring: str
    instance: int
    score: float
    pose: Pose
    centre_px: FloatArray
    heading_deg: float
    appearance: Appearance
    alternative: Alternative | None
    uncertainty: Uncertainty | None
    common: CommonUncertainty | None = None
    is_guided: bool = False
    imaging: Imaging | None = None
    rival: RivalTone | None = None
    smoothing: ContourSmoothing | None = None
    eccentricity_px: FloatArray | None = None
    image: CircleImage | None = None

    @property
    def distance_m(self) -> float:
        """Camera centre to target centre [m]."""
        return self.pose.distance_m

    @property
    def sd_distance_m(self) -> float:
        """Standard deviation of the distance [m]; NaN where the method estimates none."""
        return math.nan if self.uncertainty is None else self.uncertainty.sd_distance_m

    def covers(self, outline: Ellipse) -> bool:
        """Tell whether a ring lies on this plate."""
        offset = np.linalg.norm(outline.centre - self.centre_px)
        return bool(offset < self.appearance.radius_px)


@dataclass(frozen=True, slots=True, eq=False)
class CircleImage:
    """The image of one circle: its centroid [px] and second moments [px²].

    No prior of target or frame has a part in it, except the motion under a rolling shutter: it is
    the image of one moment.

    Attributes
    ----------
    moments : (5,) array
        As `discs.records.MOMENTS`.
    cov : (5, 5) array
        Covariance of the moments, with the unknown part of that motion.
    """

    moments: FloatArray
    cov: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RivalTone:
    """A measurement by the less likely base of an unknown tone curve.

    Attributes
    ----------
    advantage : float
        Log-likelihood by which it is less likely.
    """

    measurement: Measurement
    advantage: float


@dataclass(frozen=True, slots=True)
class Miss:
    """One target that was not measured, and why.

    A record and not the `Rejection` itself: a kept exception keeps the frame's arrays alive.

    Attributes
    ----------
    target : str
        Name of the target.
    reason : Reason
        The word of the registry.
    detail : str
        The numbers behind it.
    score : float or None
        Normalised cross-correlation of the best candidate, if there was one.
    candidates : int
        Number of rings that were compared with the target's, without those of other measured
        targets.
    outline : Ellipse or None
        Outer edge of the best candidate, if there was one [px].
    """

    target: str
    reason: Reason
    detail: str = ""
    score: float | None = None
    candidates: int = 0
    outline: Ellipse | None = None


Outcome = Measurement | Miss


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """How the camera exposed a frame; None where the file does not say.

    Attributes
    ----------
    exposure_time_s : float or None
        Exposure time [s].
    iso : float or None
        Sensitivity.
    f_number : float or None
        Focal length over aperture.
    """

    exposure_time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None


class TimeSource(StrEnum):
    """Where the time of a frame is from."""

    TIMES_FILE = "times_file"
    EXIF = "exif"
    NONE = ""  # the time is not known


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All results of one frame.

    Attributes
    ----------
    frame : str
        Path relative to the frames folder.
    time_s : float or None
        Mid-exposure, Unix UTC [s].
    outcomes : tuple of Outcome
        At least one per target, in the targets' order.
    camera_time_s : float or None
        Time of the frame by the camera's clock, Unix UTC [s].
    dropped : tuple of Considered
        Rings that were compared with a target's and dropped, if they are to be shown.
    time_source : TimeSource
        Where `time_s` is from.
    """

    frame: str
    time_s: float | None
    exposure: ExposureSettings
    outcomes: tuple[Outcome, ...]
    camera_time_s: float | None = None
    dropped: tuple[Considered, ...] = ()
    time_source: TimeSource = TimeSource.NONE


def is_unreadable(outcome: Outcome) -> bool:
    """Tell whether an outcome is that of a frame without an image."""
    return isinstance(outcome, Miss) and outcome.reason.status is Status.UNREADABLE


@dataclass(frozen=True, slots=True)
class Considered:
    """One ring in the frame that was compared with one of a target's.

    Attributes
    ----------
    target, ring : str
        What it was compared with.
    outline : Ellipse
        Its outer circle [px].
    score : float
        Normalised cross-correlation.
    is_match : bool
        Whether it carries the code, and was to be measured.
    reason : Reason or None
        Why it was dropped; None: it was measured.
    detail : str
        The numbers behind it.
    """

    target: str
    ring: str
    outline: Ellipse
    score: float
    is_match: bool
    reason: Reason | None = None
    detail: str = ""
