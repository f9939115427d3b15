"""Checks of a vehicle's attitude against its course over ground, and against a level road."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.georef.target_positions import Vehicle
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import amount, minus, rounded
from kgcp.settings import VehicleSettings

_MAX_OFF_DEG = 20.0  # of headings from the course; crab angles and GNSS noise are far smaller
_MAX_FITTING_DEG = 8.0  # the same of another reading of the headings that fits
# A smaller steady offset displaces the target, too. Where the path turns by 0.17° per metre, a
# point 3 m before the rear axle moves half a degree aside of the heading; more would hide it.
_MAX_TURN_DEG_M = 0.17
_MIN_STEADY_DEG, _MIN_STEADY_SDS, _MIN_STEADY_STATED_SDS = 1.5, 5.0, 3.0
_PART_S, _MIN_PARTS = 5.0, 4  # of the drive, whose medians must agree
_MIN_ASIDE_M = 0.01  # displacement of the target
_MIN_CONVERGENCE_DEG, _CONVERGENCE_TOLERANCE_DEG = 1.0, 0.5
_MAX_TILT_DEG = 35.0
# Half the base of a course: over one interval of a fast logger it would be mere noise.
_HALF_BASE_S = 0.5
_MIN_SPEED_M_S = 1.0
_MIN_EPOCHS = 10
_MIN_EXTENT_M = 10.0  # of the drive
_MAX_EPOCHS = 20_000  # more would tell nothing new


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Course and attitude of a moving vehicle at n epochs."""

    time_s: FloatArray  # (n,): since the first epoch [s]
    course_deg: FloatArray  # (n,): direction of motion, clockwise from true north [deg]
    attitude_deg: FloatArray  # (n, 3): roll, pitch, heading as in the trajectory [deg]
    is_straight: BoolArray  # (n,): whether the path hardly bends
    sd_heading_deg: float  # stated standard deviation, median; 0: not stated
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
    east, north, _ = np.einsum("nji,nj->in", level, chord)
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
        attitude_deg=attitude_deg[::step][moves],
        is_straight=(np.abs(turn_deg) < _MAX_TURN_DEG_M * way_m)[moves],
        sd_heading_deg=0.0 if sds is None else float(np.median(sds[:, 2])),
        convergence_deg=math.degrees(math.atan2(grid_north[0], grid_north[1])),
    )


def check_attitude(course: Course | None, settings: VehicleSettings) -> Iterator[Doubt]:
    """Compare headings with the course, and roll and pitch with a level road.

    If they do not fit, other usual conventions are tried, and those that fit are named.
    """
    if course is not None:
        if course.median_off_deg > _MAX_OFF_DEG:
            yield _wrong_heading(course)
        else:
            yield from _check_steady_offset(course, settings)
        yield from _check_level(course)


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


def _check_steady_offset(course: Course, settings: VehicleSettings) -> Iterator[Doubt]:
    """Yield the doubt about headings that differ from the course alike wherever it is straight.

    They turn the lever arm, and nothing but reference poses would show it.
    """
    straight = course.is_straight
    off = _wrapped(course.attitude_deg[straight, 2] - course.course_deg[straight])
    part = np.floor(course.time_s[straight] / _PART_S)
    medians = np.array([np.median(off[part == number]) for number in np.unique(part)])
    if len(medians) < _MIN_PARTS:
        return
    steady = float(np.median(off))
    sd = float(np.std(medians, ddof=1)) / math.sqrt(len(medians))
    least = max(
        _MIN_STEADY_DEG,
        _MIN_STEADY_SDS * sd,
        _MIN_STEADY_STATED_SDS * course.sd_heading_deg,
        float(np.ptp(np.percentile(medians, [5.0, 95.0]))),  # more is not steady
    )
    forward, right, _ = settings.lever_arm_m
    aside_m = math.hypot(forward, right) * math.radians(abs(steady))
    if abs(steady) < least or aside_m < _MIN_ASIDE_M:
        return
    side = "clockwise" if steady > 0.0 else "anticlockwise"
    yield mild(
        Cause.HEADING,
        f"where the vehicle drives straight, headings are {amount(abs(steady), sd)}° {side} of the"
        f" course: with this lever arm, that displaces the target by {rounded(aside_m)} m",
        _remedy_of_steady_offset(steady, course.convergence_deg),
        {"steady_off_deg": steady, "sd_off_deg": sd, "aside_m": aside_m},
    )


def _remedy_of_steady_offset(off_deg: float, convergence_deg: float) -> str:
    is_by_grid = abs(off_deg + convergence_deg) < _CONVERGENCE_TOLERANCE_DEG
    if is_by_grid and abs(convergence_deg) > _MIN_CONVERGENCE_DEG:
        return (
            "give headings relative to true north: they seem to be relative to grid north; add the"
            f" meridian convergence, here {minus(f'{convergence_deg:.1f}')}°"
        )
    return (
        "give headings of the axes along which lever_arm_m is measured, relative to true north,"
        " neither to magnetic nor to grid north, and check crs"
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
