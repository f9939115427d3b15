"""Expected detection and accuracy of a target from a given height.

The image model is the simulator's: a tilted plate in the middle of the image, well exposed, with
the full well and read noise of `Sensor`. The expected accuracy of one frame is its Cramér-Rao bound
times the ratio of kgcp's errors to the bound, as measured on simulated flights. Errors of
calibration and print are given separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.errors import SettingError
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import Circles3D, eccentricity
from kgcp.geometry.pose import Pose
from kgcp.measurement.plain_prediction import smallest_radius_px
from kgcp.measurement.systematic_errors import common_uncertainty
from kgcp.settings import require_range
from kgcp.simulation.crlb import Shot, bound_of
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlainPlate, PrintedPlate
from kgcp.simulation.regions import regular_polygon
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import AnyTarget, PlainTarget

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

TILT_DEG = 6.0
"""Tilt of the plate against the viewing ray. Larger tilts hardly matter; frontal views are more
accurate."""
GAIN = 0.85
"""Exposure relative to the one at which a perfect white clips."""
SCATTER = {True: (1.0, 1.1), False: (1.4, 1.2)}
"""Ratio of the RMS error to the bound, for distance and centre. The key is whether the camera's
response is linear.

`python -m benchmarks.accuracy.planning` measured 0.98 and 1.08 on 55 targets of the flights clean,
exposure_sweep, blurred, oblique and far. It measured 1.37 and 1.22 on 38 targets of consumer (tone
curve, sharpening, JPEG): 11 with seed 1, and 27 with `--flights 30 --seed 2`.
"""
FOUND = ((6.0, 52, 52), (7.0, 54, 54), (8.0, 44, 44), (9.0, 300, 300))
"""Per band of radii: lower limit [px], number of rings found, number of rings shown.

From `python -m benchmarks.accuracy.planning` with seed 1 and 150 frames in each of the sets small,
middle and large.
"""
PLAIN_SCATTER = (1.7, 1.15)
"""Ratios as `SCATTER`, for plain discs, to the bound of their edges with known blur.

From `python -m benchmarks.ground.plain_targets`: white and black discs of 3 to 20 px, linear
response.
"""
PLAIN_FOUND = (2035, 2040)
"""Numbers of plain discs and rings found and shown, from the smallest radius on.

From `benchmarks.ground.plain_targets`: 537 of 540 with 2.5 to 3.5 px, 1498 of 1500 with 3 to 20 px.
"""
PLAIN_GAP_PX, PLAIN_HOLE_PX = 2.0, 1.0
"""Least distance between a plain ring's circles, and least radius of its innermost one [px].

Thinner rings are found as well, but edges so close together are less informative.
"""
SURE_PX = 9.0
"""Least radius to plan for [px]. In smaller rings, unforeseen blur leaves little of the dots."""
_SHARP_PSF, _SHARP_STREAK = 0.2, 0.5
"""Largest point spread and streak, relative to a ring's radius, at which its dots are recognised.

Each was tested alone, with 32 rendered rings of 9 to 40 px at each value. At point spreads of 0.18,
0.21 and 0.27, 31, 29 and 18 rings were found. At streaks of 0.5, 0.6 and 0.8, 32, 26 and none were.
"""
# Largest spread of a plain disc's edge, relative to its radius. Beyond, the disc is a smooth blob.
_SHARP_EDGE = 0.5
LARGEST_SHARE = 0.46
"""Largest radius that was tested, relative to the image's shorter side."""
_RADII_PX = (6.0, 9.0, 20.0, 45.0)  # radii for which the bound is computed
_MAX_HEIGHT_RATIO = 50.0  # of the largest to the smallest proposed height
_ROUND_STEPS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # round heights within a decade
OBLIQUE_DEG = 30.0
"""Angle between normal and viewing ray for which the eccentricity is given [deg]."""

# Directions of tilt and streak over which the bound is averaged. For small rings, it matters where
# the dots are.
_DIRECTIONS_DEG = (35.0, 125.0)
_CENTRE_OFFSET_PX = 0.3  # of the target from the middle of a pixel
_SUB_PIXELS = 150


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions under which the frames will be taken."""

    blur_px: float = 1.0  # largest motion of the image during the exposure [px]
    exposure_s: float = 0.001
    psf_px: float = 0.7  # σ of the point spread of lens and sensor [px]
    accuracy_percent: float = 0.05  # wanted standard deviation of one distance [% of it]
    speed_mps: float = 10.0  # of the camera over the target
    interval_s: float = 1.0  # between frames

    def __post_init__(self) -> None:
        require_range("blur", self.blur_px, 0.0, 30.0, unit="px")
        require_range("exposure", self.exposure_s, 0.0, 60.0, unit="s", open_low=True)
        require_range("psf", self.psf_px, 0.3, 10.0, unit="px")
        require_range("accuracy", self.accuracy_percent, 0.0, 10.0, unit="%", open_low=True)
        require_range("speed", self.speed_mps, 0.0, 1e3, unit="m/s", open_low=True)
        require_range("interval", self.interval_s, 0.0, 3600.0, unit="s", open_low=True)

    @property
    def least_ring_px(self) -> float:
        """Least radius of a ring whose dots are not blurred away [px]."""
        return math.hypot(self.psf_px / _SHARP_PSF, self.blur_px / _SHARP_STREAK)

    @property
    def least_disc_px(self) -> float:
        """Least radius of a plain disc whose edge is sharp enough [px]."""
        return math.sqrt(self.psf_px**2 + (self.blur_px**2 + 1.0) / 12.0) / _SHARP_EDGE


@dataclass(frozen=True, slots=True)
class Outlook:
    """Expected detection and accuracy at one height."""

    height_m: float  # camera above target
    ring: str | None  # the largest ring that fits into the image; None: none does
    radius_px: float  # of that ring, or else of the main ring [px]
    # probability of detection, and its 95 % interval (Wilson)
    found: float
    found_low: float
    found_high: float
    # standard deviations of one frame, for the centre per axis; None if nothing is found
    sd_distance_m: float | None
    sd_centre_px: float | None
    # by calibration and print, the same in all frames; None: flight.toml does not state them
    sd_common_distance_m: float | None
    # largest speed relative to the target at which motion blurs by at most `blur_px`
    largest_speed_mps: float
    # of the main ring, for the wanted accuracy and certain detection
    smallest_diameter_m: float
    gsd_m: float  # size of a pixel on the ground
    footprint_m: tuple[float, float]  # width and height of the image on the ground
    # number of frames with the whole main ring while the camera passes along the image's height
    frames_per_pass: float
    # offset of the centre of the ring's ellipse, in the middle of the image and at `OBLIQUE_DEG`;
    # None: the ring reaches behind the camera
    eccentricity_px: float | None


@dataclass(frozen=True, slots=True, eq=False)
class _Accuracy:
    """Standard deviations as functions of a ring's radius R.

    About R pixels see the edges of the ring. So the standard deviations of radius and centre are
    proportional to R^(-1/2), and the relative one of the distance to R^(-3/2). The factors are
    interpolated in logarithms between the computed radii, and constant beyond them.
    """

    log_distance: PchipInterpolator
    log_centre: PchipInterpolator

    def relative_distance(self, radius_px: float) -> float:
        """Return the standard deviation of the distance over the distance."""
        return _at(self.log_distance, radius_px) / math.sqrt(radius_px) ** 3

    def centre_px(self, radius_px: float) -> float:
        """Return the standard deviation of the centre per axis [px]."""
        return _at(self.log_centre, radius_px) / math.sqrt(radius_px)

    def radius_for(self, relative_distance: float) -> float:
        """Return the least radius for a relative standard deviation of the distance [px]."""
        low, high = math.log(1.0), math.log(1e5)
        for _ in range(60):
            middle = 0.5 * (low + high)
            if self.relative_distance(math.exp(middle)) > relative_distance:
                low = middle
            else:
                high = middle
        return math.exp(high)


def _at(logarithm: PchipInterpolator, radius_px: float) -> float:
    return math.exp(float(logarithm(np.clip(math.log(radius_px), *logarithm.x[[0, -1]]))))


def usual_heights(camera: Camera, target: AnyTarget) -> tuple[float, ...]:
    """Return round heights from which some ring of a target can be measured [m].

    Their range is limited to a factor of fifty, because a replica can be measured from closer than
    anybody flies.
    """
    if isinstance(target, PlainTarget):
        diameters_m, least_px = [target.outer_diameter_m], least_plain_px(target)
    else:
        diameters_m, least_px = [ring.outer_diameter_m for ring in target.rings], FOUND[0][0]
    px_m = [0.5 * diameter_m * camera.mean_focal_px for diameter_m in diameters_m]
    farthest = max(px_m) / least_px
    nearest = min(px_m) / (LARGEST_SHARE * min(camera.width, camera.height))
    nearest = max(nearest, farthest / _MAX_HEIGHT_RATIO)
    decades = range(math.floor(math.log10(nearest)), math.ceil(math.log10(farthest)) + 1)
    heights = (step * 10.0**decade for decade in decades for step in _ROUND_STEPS)
    return tuple(height for height in heights if nearest <= height <= farthest)


def look_ahead(
    camera: Camera,
    calibration: CalibrationCovariance | None,
    target: AnyTarget,
    heights_m: Sequence[float],
    conditions: Conditions,
) -> tuple[Outlook, ...]:
    """Return the expected detection and accuracy for each height.

    Raises
    ------
    SettingError
        If a height is impossible, or the blur is too large for any ring.
    """
    for height_m in heights_m:
        require_range("height", height_m, 0.0, 1e5, unit="m", open_low=True)
    if not heights_m:
        raise SettingError("height", "is missing", "no usual one suits this camera and target")
    if isinstance(target, PlainTarget):
        return tuple(
            _plain_outlook(camera, calibration, target, height_m, conditions)
            for height_m in heights_m
        )
    least_px = conditions.least_ring_px
    if least_px > _RADII_PX[-2]:
        raise SettingError(
            "blur",
            f"{conditions.blur_px:g} px and a point spread of {conditions.psf_px:g} px leave too"
            f" little of the dots of rings below {least_px:.0f} px",
            f"give less: the accuracy is known where rings of {_RADII_PX[-2]:g} px are found",
        )
    accuracy = _accuracy(camera, _of_unit_size(target.ring), conditions)
    wanted_px = max(accuracy.radius_for(0.01 * conditions.accuracy_percent), SURE_PX, least_px)
    return tuple(
        _outlook(camera, calibration, target, height_m, conditions, accuracy, wanted_px)
        for height_m in heights_m
    )


def _outlook(
    camera: Camera,
    calibration: CalibrationCovariance | None,
    target: Target,
    height_m: float,
    conditions: Conditions,
    accuracy: _Accuracy,
    wanted_px: float,
) -> Outlook:
    metre_px = camera.mean_focal_px / height_m
    ring = _seen_ring(camera, target, metre_px)
    radius_px = 0.5 * (ring or target.ring).outer_diameter_m * metre_px
    is_sharp = radius_px >= conditions.least_ring_px
    found, low, high = chance_to_find(radius_px) if ring and is_sharp else (0.0, 0.0, 0.0)
    common = common_uncertainty(camera, calibration, target.ring, _pose(camera, height_m))
    return Outlook(
        height_m=height_m,
        ring=None if ring is None else ring.name,
        radius_px=radius_px,
        found=found,
        found_low=low,
        found_high=high,
        sd_distance_m=height_m * accuracy.relative_distance(radius_px) if found else None,
        sd_centre_px=accuracy.centre_px(radius_px) if found else None,
        sd_common_distance_m=None if common is None else common.sd_distance_m,
        largest_speed_mps=conditions.blur_px / metre_px / conditions.exposure_s,
        smallest_diameter_m=2.0 * wanted_px / metre_px,
        gsd_m=1.0 / metre_px,
        footprint_m=(camera.width / metre_px, camera.height / metre_px),
        frames_per_pass=max(0.0, camera.height / metre_px - target.ring.outer_diameter_m)
        / (conditions.speed_mps * conditions.interval_s),
        eccentricity_px=_eccentricity_px(camera, radius_px),
    )


def _plain_outlook(
    camera: Camera,
    calibration: CalibrationCovariance | None,
    target: PlainTarget,
    height_m: float,
    conditions: Conditions,
) -> Outlook:
    metre_px = camera.mean_focal_px / height_m
    radius_px = target.radii_m[0] * metre_px
    least_px = max(least_plain_px(target), conditions.least_disc_px)
    is_whole = radius_px <= LARGEST_SHARE * min(camera.width, camera.height)
    is_found = is_whole and radius_px >= least_px
    found, low, high = _wilson(*PLAIN_FOUND) if is_found else (0.0, 0.0, 0.0)
    by_distance, by_centre = _plain_accuracy(camera, target, radius_px, conditions)
    # relative deviations of distances fall with R^(-3/2)
    wanted = 0.01 * conditions.accuracy_percent
    wanted_px = radius_px * (by_distance / wanted) ** (2.0 / 3.0) if wanted else math.inf
    common = common_uncertainty(camera, calibration, target, _pose(camera, height_m))
    return Outlook(
        height_m=height_m,
        ring=target.name if is_whole else None,
        radius_px=radius_px,
        found=found,
        found_low=low,
        found_high=high,
        sd_distance_m=height_m * by_distance if found else None,
        sd_centre_px=by_centre if found else None,
        sd_common_distance_m=None if common is None else common.sd_distance_m,
        largest_speed_mps=conditions.blur_px / metre_px / conditions.exposure_s,
        smallest_diameter_m=2.0 * max(wanted_px, least_px) / metre_px,
        gsd_m=1.0 / metre_px,
        footprint_m=(camera.width / metre_px, camera.height / metre_px),
        frames_per_pass=max(0.0, camera.height / metre_px - target.outer_diameter_m)
        / (conditions.speed_mps * conditions.interval_s),
        eccentricity_px=_eccentricity_px(camera, radius_px),
    )


def least_plain_px(target: PlainTarget) -> float:
    """Return the least radius at which all circles of a plain target are distinguished [px]."""
    radii = target.radii_m
    least_px = smallest_radius_px(target)
    if len(radii) == 1:
        return least_px
    narrowest_m = min(outer - inner for outer, inner in pairwise(radii))
    return max(
        least_px,
        PLAIN_GAP_PX * radii[0] / narrowest_m,
        PLAIN_HOLE_PX * radii[0] / radii[-1],
    )


def _plain_accuracy(
    camera: Camera, target: PlainTarget, radius_px: float, conditions: Conditions
) -> tuple[float, float]:
    """Return standard deviations: of the distance, relative, and of the centre per axis [px].

    A disc has the radius R and an edge of spread s and contrast C in noise σ_n. Its edge determines
    the centre to σ_c = (σ_n / C) √(2 s / (√π R)), the radius to σ_c / √2, and a semi-axis to
    √1.5 σ_c. The normal has the standard deviation σ by its prior and by the axes together, which
    displaces the centre by (R² / f) σ.
    """
    sensor = Sensor()
    plate = PlainPlate(target)
    bright, dark = GAIN * plate.bright, GAIN * plate.dark
    electrons = sensor.full_well_e * 0.5 * (bright + dark) + sensor.read_noise_e**2
    noise = math.hypot(math.sqrt(electrons) / sensor.full_well_e, 1.0 / math.sqrt(12.0) / 255.0)
    edge_px = math.sqrt(conditions.psf_px**2 + (conditions.blur_px**2 / 2.0 + 1.0) / 12.0)
    shares = [radius_m / target.radii_m[0] for radius_m in target.radii_m]
    centre_px = noise / (bright - dark)
    centre_px *= math.sqrt(2.0 * edge_px / (math.sqrt(math.pi) * radius_px * sum(shares)))
    # the information of a circle's radius about the scale is proportional to R_i²
    scale = centre_px / math.sqrt(2.0) / radius_px
    scale *= math.sqrt(sum(shares) / sum(share**3 for share in shares))
    by_axes = math.sqrt(1.5) * centre_px / (radius_px * math.sin(math.radians(TILT_DEG)))
    sd_normal = 1.0 / math.hypot(1.0 / by_axes, 1.0 / math.radians(target.sd_normal_deg))
    by_normal_px = radius_px**2 / camera.mean_focal_px * sd_normal
    by_distance, by_centre = PLAIN_SCATTER
    return by_distance * scale, by_centre * math.hypot(centre_px, by_normal_px)


def _eccentricity_px(camera: Camera, radius_px: float) -> float | None:
    angle_rad = math.radians(OBLIQUE_DEG)
    circle = Circles3D.with_normals(
        np.array([[0.0, 0.0, 1.0]]),
        np.array([[math.sin(angle_rad), 0.0, math.cos(angle_rad)]]),
        np.array([radius_px / camera.mean_focal_px]),
    )
    offset_px = float(np.linalg.norm(eccentricity(camera, circle).total_px[0]))
    return offset_px if math.isfinite(offset_px) else None


def _seen_ring(camera: Camera, target: Target, metre_px: float) -> Ring | None:
    """Return the largest ring that fits into the image."""
    largest_px = LARGEST_SHARE * min(camera.width, camera.height)
    fitting = (r for r in target.rings if 0.5 * r.outer_diameter_m * metre_px <= largest_px)
    return next(fitting, None)


def chance_to_find(radius_px: float) -> tuple[float, float, float]:
    """Return the probability that a ring is found, and its 95 % interval (Wilson).

    E. B. Wilson, JASA 22 (1927), 209–212.
    """
    bands = [(found, shown) for low_px, found, shown in FOUND if low_px <= radius_px]
    if not bands:
        return 0.0, 0.0, 0.0
    return _wilson(*bands[-1])


def _wilson(found: int, shown: int) -> tuple[float, float, float]:
    # imported here because it takes long, and only plans need it
    from scipy.stats import binomtest

    interval = binomtest(found, shown).proportion_ci(0.95, method="wilson")
    return found / shown, float(interval.low), float(interval.high)


def _of_unit_size(ring: Ring) -> Ring:
    """Return a ring of the same proportions with a diameter of 1 m."""
    lengths_m = (ring.inner_diameter_m, ring.code_diameter_m, ring.dot_diameter_m)
    inner, code, dot = (round(length_m / ring.outer_diameter_m, 6) for length_m in lengths_m)
    return Ring("", 1.0, inner, code, dot, ring.code_deg)


@lru_cache(maxsize=8)
def _accuracy(camera: Camera, ring: Ring, conditions: Conditions) -> _Accuracy:
    """Return bounds times scatter for some radii, averaged over directions of tilt and streak."""
    blur_px = conditions.blur_px
    radii_px = np.array([each for each in _RADII_PX if each >= conditions.least_ring_px])
    # The middle of the image has no distortion. The image is large, so that it holds every ring.
    spacious = Camera(1000, 1000, camera.fx, camera.fy, 499.5, 499.5, response=camera.response)
    plate = PrintedPlate(Target(ring), regular_polygon(4, 0.7 * ring.outer_diameter_m))
    by_distance, by_centre = SCATTER[camera.response is Response.LINEAR]
    variances = np.zeros((2, len(radii_px)))
    for column, radius_px in enumerate(radii_px.tolist()):
        distance_m = 0.5 * ring.outer_diameter_m * camera.mean_focal_px / radius_px
        for direction_deg in _DIRECTIONS_DEG:
            direction = math.radians(direction_deg)
            optics = Optics(
                conditions.psf_px, (blur_px * math.cos(direction), blur_px * math.sin(direction))
            )
            pose = _pose(camera, distance_m, direction)
            shot = Shot(spacious, plate, pose, optics, Sensor(), GAIN, blur_px > 0.0, _SUB_PIXELS)
            bound = bound_of(shot)
            variances[:, column] += (0.01 * bound.distance_percent) ** 2, 0.5 * bound.centre_px**2
    from scipy.interpolate import PchipInterpolator  # 0.2 s that `kgcp detect` does not need

    distance, centre = np.sqrt(variances / len(_DIRECTIONS_DEG))
    return _Accuracy(
        PchipInterpolator(np.log(radii_px), np.log(by_distance * distance * radii_px**1.5)),
        PchipInterpolator(np.log(radii_px), np.log(by_centre * centre * radii_px**0.5)),
    )


def _pose(camera: Camera, distance_m: float, direction: float = 0.0) -> Pose:
    """Return the pose of a plate in the middle of the image, tilted in a direction [rad]."""
    axis = math.radians(TILT_DEG) * np.array([-math.sin(direction), math.cos(direction), 0.0])
    offset = _CENTRE_OFFSET_PX / camera.mean_focal_px
    ray = np.array([offset, -offset, 1.0])
    return Pose(
        Rotation.from_rotvec(axis).as_matrix(), distance_m * ray / float(np.linalg.norm(ray))
    )
