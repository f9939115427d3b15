"""Poses and their angles against scipy's rotations and the written conventions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, image_heading_deg, rotation_about

CAMERA = Camera(1600, 1100, 2306.0, 2302.0, 792.6, 543.9, k1=-0.07, k2=0.05, p1=3e-4, p2=-4e-4)
AHEAD = np.array([0.0, 0.0, 20.0])


def tilted(rotation_vector_deg: FloatArray, translation_m: FloatArray = AHEAD) -> Pose:
    rotation = Rotation.from_rotvec(np.radians(rotation_vector_deg)).as_matrix()
    return Pose(rotation, translation_m)


@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3), st.floats(-9.0, 0.0))
def test_rotation_about_equals_scipy(vector: list[float], exponent: float) -> None:
    turn = 10.0**exponent * np.array(vector)
    np.testing.assert_allclose(
        rotation_about(turn), Rotation.from_rotvec(turn).as_matrix(), atol=1e-13
    )


def test_a_plate_that_faces_the_camera_has_no_angles() -> None:
    pose = Pose(np.eye(3), AHEAD)
    assert (pose.roll_deg, pose.pitch_deg) == (0.0, 0.0)
    assert image_heading_deg(CAMERA, pose) == pytest.approx(0.0, abs=0.05)
    np.testing.assert_array_equal(pose.quaternion_wxyz, [1.0, 0.0, 0.0, 0.0])


def test_roll_and_pitch_are_the_slopes_of_the_plate_s_diameters() -> None:
    """The diameter in the yz plane is the plate's intersection with it, likewise that in xz."""
    pose = tilted(np.array([13.0, -21.0, 50.0]))
    in_yz = np.cross(pose.normal, [1.0, 0.0, 0.0])
    in_xz = np.cross(pose.normal, [0.0, 1.0, 0.0])
    roll = math.degrees(math.atan(in_yz[2] / in_yz[1]))
    pitch = math.degrees(math.atan(in_xz[2] / in_xz[0]))
    assert pose.roll_deg == pytest.approx(roll)
    assert pose.pitch_deg == pytest.approx(pitch)
    assert tilted(np.array([13.0, 0.0, 0.0])).roll_deg == pytest.approx(13.0)


@pytest.mark.parametrize("turn_deg", [-170.0, -33.0, 90.0, 141.0])
def test_heading_is_the_direction_of_the_x_axis_in_the_image(turn_deg: float) -> None:
    pose = Pose(np.eye(3), np.array([3.0, -2.0, 15.0])).turned(turn_deg)
    tip, tail = CAMERA.project(pose.transform(np.array([[1e-5, 0.0], [-1e-5, 0.0]])))
    dx, dy = tip - tail
    assert image_heading_deg(CAMERA, pose) == pytest.approx(
        math.degrees(math.atan2(dy, dx)), abs=1e-5
    )


def test_turning_a_plate_on_the_axis_turns_its_heading_clockwise() -> None:
    square = Camera(800, 600, 1000.0, 1000.0, 400.0, 300.0)
    pose = Pose(np.eye(3), AHEAD).turned(70.0)
    assert image_heading_deg(square, pose) == pytest.approx(70.0)
    assert pose.roll_deg == pytest.approx(0.0, abs=1e-12)


def test_a_step_moves_in_metres_and_turns_in_the_camera_frame() -> None:
    pose = tilted(np.array([10.0, 20.0, -70.0]), np.array([1.0, -2.0, 12.0]))
    step = np.array([0.1, -0.2, 0.3, 0.02, -0.01, 0.03])
    moved = pose.moved(step)
    np.testing.assert_allclose(moved.translation_m, [1.1, -2.2, 12.3])
    left = Rotation.from_matrix(moved.rotation @ pose.rotation.T).as_rotvec()
    np.testing.assert_allclose(left, step[3:], atol=1e-12)


@given(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0), st.floats(-180.0, 180.0))
def test_mirroring_keeps_the_tilt_and_is_its_own_inverse(x: float, y: float, z: float) -> None:
    translation_m = np.array([2.0, -1.0, 12.0])
    pose = tilted(np.array([x, y, z]), translation_m)
    mirrored = pose.mirrored()
    ray = translation_m / pose.distance_m
    assert mirrored.normal @ ray == pytest.approx(pose.normal @ ray, abs=1e-9)
    expected = 2.0 * (pose.normal @ ray) * ray - pose.normal
    np.testing.assert_allclose(mirrored.normal, expected, atol=1e-9)
    np.testing.assert_allclose(mirrored.mirrored().rotation, pose.rotation, atol=1e-7)
    np.testing.assert_array_equal(mirrored.translation_m, translation_m)


def test_a_frontal_plate_is_its_own_mirror_image() -> None:
    pose = Pose(np.eye(3), AHEAD)
    assert pose.mirrored() is pose


@given(st.lists(st.floats(-180.0, 180.0), min_size=3, max_size=3))
def test_quaternions_are_unit_and_their_real_part_is_not_negative(vector: list[float]) -> None:
    pose = tilted(np.array(vector))
    quaternion = pose.quaternion_wxyz
    assert quaternion[0] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    back = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(back, pose.rotation, atol=1e-12)


def test_points_on_the_plate_need_no_third_coordinate() -> None:
    pose = tilted(np.array([10.0, 20.0, -70.0]))
    flat = np.array([[0.3, -0.2], [0.1, 0.4]])
    whole = np.column_stack((flat, np.zeros(2)))
    np.testing.assert_allclose(pose.transform(flat), pose.transform(whole))
    np.testing.assert_allclose(pose.transform(whole), whole @ pose.rotation.T + AHEAD)


@pytest.mark.parametrize("tilt_deg", [0.0, 4.0, 11.0])
def test_a_pose_is_tilted_in_its_own_direction_and_no_less_than_before(tilt_deg: float) -> None:
    translation_m = np.array([3.0, -5.0, 40.0])
    ray = translation_m / np.linalg.norm(translation_m)
    facing = Rotation.align_vectors(ray[None], np.array([[0.0, 0.0, 1.0]]))[0]
    way = facing.apply([math.cos(0.7), math.sin(0.7), 0.0])
    turn = Rotation.from_rotvec(math.radians(tilt_deg) * way)
    pose = Pose((turn * facing).as_matrix(), translation_m)
    tilted = pose.tilted(math.radians(8.0))
    sine = np.cross(ray, tilted.normal)
    assert math.degrees(math.asin(np.linalg.norm(sine))) == pytest.approx(max(8.0, tilt_deg))
    if tilt_deg:
        np.testing.assert_allclose(sine / np.linalg.norm(sine), way, atol=1e-9)
    np.testing.assert_array_equal(tilted.translation_m, translation_m)


def test_tilted_across_is_perpendicular_to_the_tilt() -> None:
    pose = tilted(np.array([4.0, -3.0, 50.0]), np.array([2.0, -1.0, 20.0]))
    across = pose.tilted_across(math.radians(9.0))
    ray = pose.translation_m / pose.distance_m
    before, after = (each.normal - (ray @ each.normal) * ray for each in (pose, across))
    assert math.degrees(math.acos(ray @ across.normal)) == pytest.approx(9.0)
    assert before @ after == pytest.approx(0.0, abs=1e-12)
