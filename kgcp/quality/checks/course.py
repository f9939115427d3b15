"""Checks of a vehicle's attitude against its course over ground, and against a level road."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.georef.target_positions import Vehicle
from kgcp.georef.trajectory import Motion
from kgcp.georef.unix_time import date_of
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import amount, counted, minus, rounded
from kgcp.settings import VehicleSettings

_MAX_OFF_DEG = 20.0  # of headings from the course; crab angles and GNSS noise are far smaller
_MAX_FITTING_DEG = 8.0  # the same of another reading of the headings that fits
# Where the path turns by 0.17° per metre, a point 3 m before the rear axle moves half a degree
# aside of the heading.
_MAX_TURN_DEG_M = 0.17
_MAX_TILT_DEG = 35.0
# Least offsets that are doubted. Bodies are pitched by a degree or so against the road, which
# itself falls by up to 1.5° to its edge, and by 4° only in bends.
_MIN_HEADING_DEG, _MIN_PITCH_DEG, _MIN_ROLL_DEG = 1.5, 2.5, 4.0
_MIN_SDS, _MIN_STATED_SDS = 5.0, 3.0
_MIN_ASIDE_M = 0.01  # displacement of the target
_PART_S, _MIN_PARTS = 5.0, 4  # of the drive, whose medians must agree
_MIN_CONVERGENCE_DEG, _CONVERGENCE_TOLERANCE_DEG = 1.0, 0.5
_OF_HEADING = (
    "give headings of the axes along which lever_arm_m is measured, relative to true north, neither"
    " to magnetic nor to grid north, and check crs"
)
_OF_TILT = (
    "give roll and pitch of the axes along which lever_arm_m is measured: those of the instrument"
    " may be turned against the vehicle's"
)
# Half the base of a course: over one interval of a fast logger it would be mere noise.
_HALF_BASE_S = 0.5
_MIN_SPEED_M_S = 1.0
_MIN_EPOCHS = 10
_MIN_EXTENT_M = 10.0  # of the drive
_MAX_EPOCHS = 20_000  # more would tell nothing new
_MIN_FLIP_DEG, _MAX_FLIP_S = 120.0, 2.0  # between two epochs: no vehicle turns so fast
_MIN_FLIPPED_M = 0.02  # displacement of the target by half a turn of the heading


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Course and attitude of a moving vehicle at n epochs."""

    time_s: FloatArray  # (n,): since the first epoch [s]
    course_deg: FloatArray  # (n,): direction of motion, clockwise from true north [deg]
    slope_deg: FloatArray  # (n,): of the path, upwards [deg]
    attitude_deg: FloatArray  # (n, 3): roll, pitch, heading as in the trajectory [deg]
    is_straight: BoolArray  # (n,): whether the path hardly bends
    sd_attitude_deg: FloatArray  # (3,): stated standard deviations, medians; 0: not stated
    convergence_deg: float  # direction of grid north, clockwise from true north [deg]

    @property
    def median_off_deg(self) -> float:
        """Median difference of headings from the course [deg]."""
        return _median_off(self.attitude_deg[:, 2], self.course_deg)


def course_of(vehicle: Vehicle, attitude_deg: FloatArray) -> Course | None:
    """Return course and attitude while the vehicle moves; None if it hardly does.

    `attitude_deg` (n, 3) are the trajectory's own angles. Those of rotations are wrapped at 360°,
    which angles in gon would not survive.
    """
    motion = vehicle.motion
    span = np.linalg.norm(np.ptp(motion.position_m[:, :2], axis=0))
    if span < _MIN_EXTENT_M:
        return None
    step = max(1, len(motion.time_s) // _MAX_EPOCHS)
    since = motion.time_s - motion.time_s[0]
    middle = since[::step]
    start, end = middle - _HALF_BASE_S, middle + _HALF_BASE_S
    chord = np.column_stack(
        [
            np.interp(end, since, axis) - np.interp(start, since, axis)
            for axis in motion.position_m.T
        ]
    )
    level = vehicle.local_frame.level_rotations(motion.position_m[::step])
    east, north, up = np.einsum("nji,nj->in", level, chord)
    base_s = np.minimum(end, since[-1]) - np.maximum(start, 0.0)
    way_m = np.hypot(east, north)
    moves = way_m > _MIN_SPEED_M_S * base_s
    if np.count_nonzero(moves) < _MIN_EPOCHS:
        return None
    heading = np.unwrap(attitude_deg[:, 2], period=360.0)
    turn_deg = np.interp(end, since, heading) - np.interp(start, since, heading)
    sds = motion.sd_attitude_deg
    grid_north = vehicle.local_frame.grid_rotation(motion.position_m[0])[:, 1]
    return Course(
        time_s=middle[moves],
        course_deg=np.degrees(np.arctan2(east, north))[moves],
        slope_deg=np.degrees(np.arctan2(up, way_m))[moves],
        attitude_deg=attitude_deg[::step][moves],
        is_straight=(np.abs(turn_deg) < _MAX_TURN_DEG_M * way_m)[moves],
        sd_attitude_deg=np.zeros(3) if sds is None else np.median(sds, axis=0),
        convergence_deg=math.degrees(math.atan2(grid_north[0], grid_north[1])),
    )


def check_attitude(course: Course | None) -> Iterator[Doubt]:
    """Compare headings with the course, and roll and pitch with a level road.

    If they do not fit, other usual conventions are tried, and those that fit are named.
    """
    if course is not None:
        if course.median_off_deg > _MAX_OFF_DEG:
            yield _wrong_heading(course)
        yield from _check_level(course)


def check_flips(
    motion: Motion, heading_deg: FloatArray, settings: VehicleSettings
) -> Iterator[Doubt]:
    """Yield the doubt about headings (n,) that turn to the other side from one epoch to the next.

    The course over ground does so where a vehicle reverses, and so do two antennas that are taken
    for each other. The target is then on the other side of the trajectory point.
    """
    steps_s, turns_deg = np.diff(motion.time_s), np.abs(_wrapped(np.diff(heading_deg)))
    flips = np.flatnonzero((turns_deg > _MIN_FLIP_DEG) & (steps_s < _MAX_FLIP_S))
    aside_m = 2.0 * math.hypot(*settings.lever_arm_m[:2])
    if not flips.size or aside_m < _MIN_FLIPPED_M:
        return
    first = int(flips[0])
    after_utc = f"{date_of(float(motion.time_s[first])):%Y-%m-%d %H:%M:%S}"
    later = f", and {counted(len(flips) - 1, 'time')} later" if len(flips) > 1 else ""
    yield mild(
        Cause.HEADING,
        f"headings turn by {turns_deg[first]:.0f}° in {rounded(float(steps_s[first]))} s after"
        f" {after_utc} UTC{later}: no vehicle turns so fast; if it reverses on one side of such a"
        f" turn, points there are displaced by {rounded(aside_m)} m",
        "give a trajectory with the headings of the vehicle itself, or delete the epochs in which"
        " it reverses, so that frames get no points there",
        {"turn_deg": float(turns_deg[first]), "times": float(len(flips)), "aside_m": aside_m},
    )


Reading = tuple[str, str, Callable[[FloatArray], FloatArray]]

READINGS: tuple[Reading, ...] = (
    ("180° from the course", "add 180° to every heading", lambda angle: angle + 180.0),
    (
        "90° minus the course, the mathematical convention (anticlockwise from east)",
        "give heading = 90° − angle, clockwise from north",
        lambda angle: 90.0 - angle,
    ),
    (
        "anticlockwise from north",
        "change the sign of every heading",
        lambda angle: -angle,
    ),
    ("in radians", "give roll, pitch and heading in degrees", np.degrees),
    (
        "in radians, anticlockwise from east",
        "give heading in degrees, clockwise from north",
        lambda angle: 90.0 - np.degrees(angle),
    ),
    ("in gon", "give roll, pitch and heading in degrees", lambda angle: 0.9 * angle),
    ("90° ahead of the course", "subtract 90° from every heading", lambda angle: angle - 90.0),
    ("90° behind the course", "add 90° to every heading", lambda angle: angle + 90.0),
    (
        "anticlockwise from south",
        "give heading = 180° − angle, clockwise from north",
        lambda angle: 180.0 - angle,
    ),
)
"""Other conventions of headings, the likelier first: words, remedy and conversion to a heading."""

_ANTICLOCKWISE_FROM_EAST = 1
_RADIANS = 3, 4


def _wrong_heading(course: Course) -> Doubt:
    """Return the doubt about headings in other directions than the course; it names what fits."""
    heading = course.attitude_deg[:, 2]
    off = course.median_off_deg
    figures = {"median_off_deg": off, "epochs": float(len(heading))}
    if not np.any(heading):
        return grave(
            Cause.HEADING,
            "headings are 0 at all epochs, but the vehicle drives in other directions",
            'give a trajectory with attitude, or [vehicle] attitude = "course" with'
            " sd_attitude_deg",
            figures,
        )
    sentence = f"headings are {off:.0f}° from the course over ground while driving (median)"
    may_be_radians = bool(np.all(np.abs(_wrapped(heading)) <= 2.0 * math.pi + 0.01))
    fits = []
    for index, (words, remedy, convert) in enumerate(READINGS):
        if (index in _RADIANS) and not may_be_radians:
            continue
        converted_off = _median_off(convert(heading), course.course_deg)
        if converted_off < _MAX_FITTING_DEG:
            fits.append((converted_off, index, words, remedy))
    if may_be_radians:  # if all angles are so small, other readings are less likely
        fits.sort(key=lambda fit: (fit[1] not in _RADIANS, fit[1]))
    else:
        enough = 2.0 * min((fit[0] for fit in fits), default=0.0) + 1.0
        fits.sort(key=lambda fit: (fit[0] > enough, fit[1]))
    if not fits:
        return grave(
            Cause.HEADING,
            f"{sentence}, and no other convention fits",
            "check the columns roll_deg, pitch_deg, heading_deg and the order of x and y",
            figures,
        )
    converted_off, index, words, remedy = fits[0]
    code = Cause.ANGLE_UNIT if index in (*_RADIANS, 5) else Cause.HEADING
    others = "".join(f", or {fit[2]}" for fit in fits[1:3])
    if index == _ANTICLOCKWISE_FROM_EAST:
        remedy += ", unless x and y of the trajectory are exchanged"
    return grave(
        code,
        f"{sentence}: they seem to be {words}{others}",
        remedy,
        {**figures, "left_deg": converted_off},
    )


def _check_level(course: Course) -> Iterator[Doubt]:
    roll, pitch = np.median(course.attitude_deg[:, :2], axis=0).tolist()
    if max(abs(roll), abs(pitch)) < _MAX_TILT_DEG:
        return
    words = "its z axis points up" if abs(roll) > 145.0 else "no vehicle is tilted so much"
    yield grave(
        Cause.ATTITUDE,
        f"the vehicle's roll is {roll:.0f}° and its pitch {pitch:.0f}° (medians): {words}",
        "give roll, pitch and heading of axes x forward, y right, z down relative to north, east,"
        " down",
        {"roll_deg": roll, "pitch_deg": pitch},
    )


def _median_off(heading_deg: FloatArray, course_deg: FloatArray) -> float:
    return float(np.median(np.abs(_wrapped(heading_deg - course_deg))))


def _wrapped(angle_deg: FloatArray) -> FloatArray:
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Angle:
    """One of the angles, where the vehicle drives straight."""

    code: Cause
    words: tuple[str, str, str]  # before the offset, and after a positive and a negative one
    off_deg: FloatArray  # (n,): from what it should be [deg]
    least_deg: float  # offset that is doubted
    sd_deg: float  # stated standard deviation; 0: not stated
    arm_m: float  # length of the lever arm that it turns


def check_steady_offsets(course: Course | None, settings: VehicleSettings) -> Iterator[Doubt]:
    """Yield doubts about angles that are off alike in all straight parts of the drive.

    Headings should be those of the course, pitch the slope of the path, and roll small. Offsets
    turn the lever arm and displace the target. They arise from headings relative to grid or
    magnetic north, from the CRS of another zone, or from an instrument that is turned against the
    axes along which the lever arm is measured. Without reference poses of the camera, nothing else
    shows them.
    """
    if course is None or course.median_off_deg > _MAX_OFF_DEG:
        return
    part = np.floor(course.time_s[course.is_straight] / _PART_S)
    if len(np.unique(part)) < _MIN_PARTS:
        return
    for angle in _angles(course, settings):
        medians = np.array([np.median(angle.off_deg[part == each]) for each in np.unique(part)])
        off_deg = float(np.median(angle.off_deg))
        sd_deg = float(np.std(medians, ddof=1)) / math.sqrt(len(medians))
        spread_deg = float(np.ptp(np.percentile(medians, [5.0, 95.0])))
        least_deg = max(
            angle.least_deg, _MIN_SDS * sd_deg, _MIN_STATED_SDS * angle.sd_deg, spread_deg
        )
        aside_m = angle.arm_m * math.radians(abs(off_deg))
        is_doubted = least_deg < abs(off_deg) < _MAX_TILT_DEG and aside_m > _MIN_ASIDE_M
        if not is_doubted:
            continue
        before, positive, negative = angle.words
        is_heading = angle.code is Cause.HEADING
        yield mild(
            angle.code,
            f"where the vehicle drives straight, {before} {amount(abs(off_deg), sd_deg)}°"
            f" {positive if off_deg > 0.0 else negative}: with this lever arm, that displaces the"
            f" target by {rounded(aside_m)} m",
            _remedy_of_heading(off_deg, course.convergence_deg) if is_heading else _OF_TILT,
            {"off_deg": off_deg, "sd_off_deg": sd_deg, "aside_m": aside_m},
        )


def _angles(course: Course, settings: VehicleSettings) -> tuple[_Angle, ...]:
    roll_deg, pitch_deg, heading_deg = course.attitude_deg[course.is_straight].T
    sd_roll_deg, sd_pitch_deg, sd_heading_deg = course.sd_attitude_deg.tolist()
    forward_m, right_m, down_m = settings.lever_arm_m
    return (
        _Angle(
            Cause.HEADING,
            ("headings are", "clockwise of the course", "anticlockwise of the course"),
            _wrapped(heading_deg - course.course_deg[course.is_straight]),
            _MIN_HEADING_DEG,
            sd_heading_deg,
            math.hypot(forward_m, right_m),
        ),
        _Angle(
            Cause.ATTITUDE,
            ("pitch is", "above the slope of the path", "below the slope of the path"),
            pitch_deg - course.slope_deg[course.is_straight],
            _MIN_PITCH_DEG,
            sd_pitch_deg,
            math.hypot(forward_m, down_m),
        ),
        _Angle(
            Cause.ATTITUDE,
            ("it rolls", "to the right", "to the left"),
            roll_deg,
            _MIN_ROLL_DEG,
            sd_roll_deg,
            math.hypot(right_m, down_m),
        ),
    )


def _remedy_of_heading(off_deg: float, convergence_deg: float) -> str:
    is_by_grid = abs(off_deg + convergence_deg) < _CONVERGENCE_TOLERANCE_DEG
    if is_by_grid and abs(convergence_deg) > _MIN_CONVERGENCE_DEG:
        return (
            "give headings relative to true north: they seem to be relative to grid north; add the"
            f" meridian convergence, here {minus(f'{convergence_deg:.1f}')}°"
        )
    return _OF_HEADING
