from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.target_positions import Vehicle
from kgcp.georef.trajectory import Trajectory, attitude_from_course
from kgcp.quality.checks.course import (
    Course,
    check_attitude,
    check_flips,
    check_steady_offsets,
    course_of,
)
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.lever_arm import check_lever_arm, lever_arm_text
from kgcp.settings import VehicleSettings

ARM = VehicleSettings(lever_arm_m=(-0.8, 0.15, -1.95))
ORIGIN = np.array([689586.0, 5336252.0, 500.0])  # grid north is 1.9° from true north there
TIME_S = np.arange(0.0, 60.0, 0.05)
ANGLE = 0.05 * TIME_S + 0.3


def drive(
    turned: Callable[[FloatArray], FloatArray] = lambda heading: heading,
    roll: float = 0.3,
) -> Course | None:
    """A bend of nearly half a circle to the left, first to the north."""
    xy = 150.0 * np.column_stack((np.cos(ANGLE), np.sin(ANGLE)))
    course = (-np.degrees(ANGLE)) % 360.0
    attitude = np.column_stack((0 * course + roll, 0 * course, turned(course)))
    return course_along(ORIGIN + np.column_stack((xy, 0.0 * TIME_S)), attitude)


def course_along(
    position: FloatArray, attitude: FloatArray, sd_attitude_deg: FloatArray | None = None
) -> Course | None:
    trajectory = Trajectory(TIME_S, position, attitude, None, sd_attitude_deg)
    return course_of(Vehicle.on(trajectory, ARM, LocalFrame.at("EPSG:25832", ORIGIN)), attitude)


def straight_drive(
    heading_deg: float,
    *,
    grid_deg: float = 30.0,
    stated_deg: float = 0.3,
    roll_deg: float = 0.0,
    pitch_deg: float = 0.0,
) -> Course:
    """A drive at 10 m/s up a slope of 3 % in one direction of the grid, with noise."""
    rng = np.random.default_rng(3)
    azimuth = np.radians(grid_deg)
    way = np.outer(10.0 * TIME_S, [np.sin(azimuth), np.cos(azimuth), 0.03])
    position = ORIGIN + way + 0.01 * rng.standard_normal(way.shape)
    heading = heading_deg + 0.3 * rng.standard_normal(len(TIME_S))
    attitude = np.column_stack((0.0 * heading + roll_deg, 0.0 * heading + pitch_deg, heading))
    course = course_along(position, attitude, np.full(attitude.shape, stated_deg))
    assert course is not None
    return course


def test_headings_along_the_course_raise_no_doubt() -> None:
    course = drive()
    assert course is not None
    assert course.median_off_deg == pytest.approx(1.9, abs=0.3)
    assert not [*check_attitude(course)]
    assert not [*check_attitude(drive(lambda heading: heading + 15.0))]


@pytest.mark.parametrize(
    ("turned", "code", "words"),
    [
        (lambda h: -h, Cause.HEADING, "anticlockwise from north"),
        (lambda h: 90.0 - h, Cause.HEADING, "anticlockwise from east"),
        (lambda h: h + 180.0, Cause.HEADING, "180° from the course"),
        (np.radians, Cause.ANGLE_UNIT, "in radians"),
        (lambda h: np.radians((h + 180.0) % 360.0 - 180.0), Cause.ANGLE_UNIT, "in radians"),
        (lambda h: h / 0.9, Cause.ANGLE_UNIT, "in gon"),
        (lambda h: h + 90.0, Cause.HEADING, "90° ahead of the course"),
        (lambda h: 47.0 + 2.0 * h, Cause.HEADING, "no other convention fits"),
    ],
)
def test_the_heading_convention_that_fits_is_named(
    turned: Callable[[FloatArray], FloatArray], code: Cause, words: str
) -> None:
    (doubt,) = check_attitude(drive(turned))
    assert doubt.is_grave
    assert doubt.code is code
    assert words in doubt.sentence.partition(", or ")[0]


@pytest.mark.parametrize(
    ("heading_deg", "stated_deg", "words"),
    [
        (31.9, 0.3, ""),
        (31.0, 0.3, ""),  # less than drivers and axes differ by
        (30.0, 0.3, "are 1.91"),
        (36.0, 0.3, "are 4.08"),
        (36.0, 2.0, ""),  # as stated
    ],
)
def test_a_steady_offset_of_headings_is_reported(
    heading_deg: float, stated_deg: float, words: str
) -> None:
    course = straight_drive(heading_deg, stated_deg=stated_deg)
    doubts = [*check_steady_offsets(course, ARM)]
    assert [doubt.code for doubt in doubts] == [Cause.HEADING] * bool(words)
    for doubt in doubts:
        assert words in doubt.sentence
        assert not doubt.is_grave
        by_grid = "add the meridian convergence, here 1.9°" in doubt.remedy
        assert by_grid == (heading_deg == 30.0)
    assert not [*check_steady_offsets(course, VehicleSettings(lever_arm_m=(0.0, 0.0, -2.0)))]


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "words"),
    [
        (1.5, 1.7, ""),  # as the road
        (-3.0, 0.0, ""),  # a road that falls to its edge, and a body that leans
        (0.0, 4.9, "pitch is 3.1810 ± 0.0026° above the slope of the path"),
        (0.0, -1.5, "pitch is 3.2190 ± 0.0026° below the slope of the path"),
        (5.0, 1.7, "it rolls 5° to the right: with this lever arm, that displaces the target by"),
    ],
)
def test_steady_offsets_of_roll_and_pitch_are_reported(
    roll_deg: float, pitch_deg: float, words: str
) -> None:
    course = straight_drive(31.9, roll_deg=roll_deg, pitch_deg=pitch_deg)
    doubts = [*check_steady_offsets(course, ARM)]
    assert [doubt.code for doubt in doubts] == [Cause.ATTITUDE] * bool(words)
    assert all(words in doubt.sentence for doubt in doubts)


def test_on_a_straight_line_all_fitting_heading_conventions_are_named() -> None:
    course = straight_drive(heading_deg=270.0, grid_deg=90.0)
    (doubt,) = check_attitude(course)
    assert "180° from the course" in doubt.sentence
    assert "anticlockwise from" in doubt.sentence


def test_axes_that_point_up_are_reported() -> None:
    (doubt,) = check_attitude(drive(roll=179.5))
    assert doubt.code is Cause.ATTITUDE
    assert "its z axis points up" in doubt.sentence


def test_a_vehicle_that_stands_has_no_course() -> None:
    position = np.tile([689586.0, 5336252.0, 500.0], (len(TIME_S), 1))
    attitude = np.zeros((len(TIME_S), 3))
    standing = Trajectory(TIME_S, position, attitude, None, None)
    frame = LocalFrame.at("EPSG:25832", position[0])
    assert course_of(Vehicle.on(standing, VehicleSettings(), frame), attitude) is None
    assert not [*check_attitude(None)]


def test_lever_arms_are_described_and_implausible_ones_are_doubted() -> None:
    arm = VehicleSettings(lever_arm_m=(-0.8, 0.15, -1.95))
    assert lever_arm_text(arm) == "0.80 m behind, 0.15 m to the right, 1.95 m above"
    assert not [*check_lever_arm(arm, ["A"])]
    (below,) = check_lever_arm(VehicleSettings(lever_arm_m=(-0.8, 0.15, 1.95)), ["A"])
    assert "1.95 m below" in below.sentence
    assert "lever_arm_m[2] = -1.95" in below.remedy
    (far,) = check_lever_arm(VehicleSettings(lever_arm_m=(-80.0, 15.0, 0.0)), ["A"])
    assert "81.4 m long" in far.sentence
    (shared,) = check_lever_arm(arm, ["A", "B"])
    assert "targets A and B share one lever arm" in shared.sentence


@pytest.mark.parametrize("rate_hz", [1.0, 20.0])
def test_a_course_that_turns_about_where_the_vehicle_reverses_is_doubted(rate_hz: float) -> None:
    time_s = np.arange(0.0, 90.0, 1.0 / rate_hz)
    way_m = 4.0 * np.interp(time_s, [0.0, 30.0, 40.0, 55.0, 90.0], [0.0, 30.0, 30.0, 15.0, 50.0])
    angle = 0.05 * way_m
    position = ORIGIN + 20.0 * np.column_stack((np.sin(angle), np.cos(angle), 0.0 * angle))
    position += np.random.default_rng(1).normal(0.0, 0.01, position.shape)
    attitude = attitude_from_course("vehicle.csv", time_s, position, "EPSG:25832")
    trajectory = Trajectory(1_781_597_700.0 + time_s, position, attitude, None, None)
    vehicle = Vehicle.on(trajectory, ARM, LocalFrame.at("EPSG:25832", ORIGIN))
    (doubt,) = check_flips(vehicle.motion, attitude[:, 2], ARM)
    assert (doubt.code, doubt.is_grave, doubt.figures["times"]) == (Cause.HEADING, False, 2.0)
    assert "UTC, and 1 time later: no vehicle turns so fast" in doubt.sentence
    assert "points there are displaced by 1.6 m" in doubt.sentence
    of_vehicle = np.degrees(angle) + 90.0
    assert not [*check_flips(vehicle.motion, of_vehicle % 360.0, ARM)]
    above = VehicleSettings(lever_arm_m=(0.0, 0.0, -1.95))
    assert not [*check_flips(vehicle.motion, attitude[:, 2], above)]
