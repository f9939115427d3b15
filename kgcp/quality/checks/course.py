"""A vehicle's attitude against its course over ground, and against the level of a road."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.target_positions import Vehicle
from kgcp.quality.checks.doubt import Cause, Doubt, grave

_LARGEST_DEG = 20.0  # a car's crab angle and GNSS noise stay far below
_FITTING_DEG = 8.0
_STEEP_DEG = 35.0
_BASE_S = 0.5  # over which a course is taken: one step of a fast logger is all noise
_MIN_SPEED_M_S = 1.0
_MIN_EPOCHS = 10
_MIN_WAY_M = 10.0
_MOST_EPOCHS = 20_000  # more tell nothing new


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A vehicle while it moves, at n epochs."""

    course_deg: FloatArray  # (n,): direction of motion, clockwise from true north [deg]
    attitude_deg: FloatArray  # (n, 3): roll, pitch, heading as the trajectory has them [deg]

    @property
    def median_off_deg(self) -> float:
        """How far headings are from the course [deg]."""
        return _median_off(self.attitude_deg[:, 2], self.course_deg)


def course_of(vehicle: Vehicle, attitude_deg: FloatArray) -> Course | None:
    """Return course and attitude while the vehicle moves; None where it hardly does.

    `attitude_deg` (n, 3) is the trajectory's own: making rotations of angles in gon loses
    whole turns.
    """
    motion = vehicle.motion
    span = np.linalg.norm(np.ptp(motion.position_m[:, :2], axis=0))
    if span < _MIN_WAY_M:
        return None
    step = max(1, len(motion.time_s) // _MOST_EPOCHS)
    since = motion.time_s - motion.time_s[0]
    middle = since[::step]
    start, end = middle - _BASE_S, middle + _BASE_S
    chord = np.column_stack(
        [
            np.interp(end, since, axis) - np.interp(start, since, axis)
            for axis in motion.position_m.T
        ]
    )
    level = vehicle.local_frame.level_rotations(motion.position_m[::step])
    east, north, _ = np.einsum("nji,nj->in", level, chord)
    whole = np.minimum(end, since[-1]) - np.maximum(start, 0.0)
    moves = np.hypot(east, north) > _MIN_SPEED_M_S * whole
    if np.count_nonzero(moves) < _MIN_EPOCHS:
        return None
    return Course(np.degrees(np.arctan2(east, north))[moves], attitude_deg[::step][moves])


def check_attitude(course: Course | None) -> Iterator[Doubt]:
    """Compare headings with the course, and roll and pitch with a level road.

    Where they do not fit, the usual other conventions are tried, and the one that fits is named.
    """
    if course is not None:
        yield from _check_heading(course)
        yield from _check_level(course)


Reading = tuple[str, str, Callable[[FloatArray], FloatArray]]

READINGS: tuple[Reading, ...] = (
    ("180° from the course", "add 180° to every heading", lambda angle: angle + 180.0),
    (
        "90° minus the course, as mathematicians count (anticlockwise from east)",
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
    ("90° ahead of the course", "take 90° from every heading", lambda angle: angle - 90.0),
    ("90° behind the course", "add 90° to every heading", lambda angle: angle + 90.0),
    (
        "anticlockwise from south",
        "give heading = 180° − angle, clockwise from north",
        lambda angle: 180.0 - angle,
    ),
)
"""Other meanings of a heading, the likelier first, and what makes a heading of each."""

_ANTICLOCKWISE_FROM_EAST = 1
_RADIANS = 3, 4


def _check_heading(course: Course) -> Iterator[Doubt]:
    """Compare headings with the course; where they differ, name the readings that fit."""
    heading = course.attitude_deg[:, 2]
    off = course.median_off_deg
    if off <= _LARGEST_DEG:
        return
    figures = {"median_off_deg": off, "epochs": float(len(heading))}
    if not np.any(heading):
        yield grave(
            Cause.HEADING,
            "headings are 0 at all epochs, but the vehicle drives in other directions",
            'give a trajectory with attitude, or [vehicle] attitude = "course" with'
            " sd_attitude_deg",
            figures,
        )
        return
    sentence = f"headings are {off:.0f}° from the course over ground while driving (median)"
    small = bool(np.all(np.abs(_wrapped(heading)) <= 2.0 * math.pi + 0.01))
    fits = []
    for index, (words, remedy, convert) in enumerate(READINGS):
        if (index in _RADIANS) and not small:
            continue
        left = _median_off(convert(heading), course.course_deg)
        if left < _FITTING_DEG:
            fits.append((left, index, words, remedy))
    if small:  # no other reading of angles that are all so small is as likely
        fits.sort(key=lambda fit: (fit[1] not in _RADIANS, fit[1]))
    else:
        enough = 2.0 * min((fit[0] for fit in fits), default=0.0) + 1.0
        fits.sort(key=lambda fit: (fit[0] > enough, fit[1]))
    if not fits:
        yield grave(
            Cause.HEADING,
            f"{sentence}, and no other reading of the angles fits",
            "check the columns roll_deg, pitch_deg, heading_deg and the order of x and y",
            figures,
        )
        return
    left, index, words, remedy = fits[0]
    code = Cause.ANGLE_UNIT if index in (*_RADIANS, 5) else Cause.HEADING
    others = "".join(f", or {fit[2]}" for fit in fits[1:3])
    if index == _ANTICLOCKWISE_FROM_EAST:
        remedy += ", unless x and y of the trajectory are exchanged"
    yield grave(
        code,
        f"{sentence}: they seem to be {words}{others}",
        remedy,
        {**figures, "left_deg": left},
    )


def _check_level(course: Course) -> Iterator[Doubt]:
    roll, pitch = np.median(course.attitude_deg[:, :2], axis=0).tolist()
    if max(abs(roll), abs(pitch)) < _STEEP_DEG:
        return
    words = "roll is about 180°: its z axis points up" if abs(roll) > 145.0 else "it lies on a side"
    yield grave(
        Cause.ATTITUDE,
        f"the vehicle's roll is {roll:.0f}° and its pitch {pitch:.0f}° (medians): {words}",
        "give the attitude of axes x forward, y right, z down, rolled from north, east, down",
        {"roll_deg": roll, "pitch_deg": pitch},
    )


def _median_off(heading_deg: FloatArray, course_deg: FloatArray) -> float:
    return float(np.median(np.abs(_wrapped(heading_deg - course_deg))))


def _wrapped(angle_deg: FloatArray) -> FloatArray:
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)
