"""The rotation of the scene about the camera, from the frames before and after."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import (
    CameraMotions,
    camera_motions,
    more_certain,
    rotations_between_frames,
    rotations_by_places,
)
from kgcp.measurement.plate_prior import SceneRotation

A_PRIORI = SceneRotation((0.0, 0.0, 0.0), math.radians(5.0))
TIME_S = np.array([0.0, 0.5, 1.1, 1.5, 2.0, 2.6, 3.0, 3.5, 4.1, 4.5])


def turning(velocity_rad_s: FloatArray, wobble_rad: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """A target that turns about the camera, with an attitude of the camera that wobbles."""
    rng = np.random.default_rng(2)
    turns = Rotation.from_rotvec(TIME_S[:, None] * velocity_rad_s)
    turns = Rotation.from_rotvec(wobble_rad * rng.standard_normal((len(TIME_S), 3))) * turns
    return turns.apply([1.0, -2.0, 20.0]), turns.as_matrix()


def test_a_uniform_rotation_is_recovered() -> None:
    velocity = np.array([0.06, -0.03, 0.02])
    rotations = rotations_between_frames(TIME_S, *turning(velocity), A_PRIORI)
    for rotation in rotations[1:-1]:
        assert np.allclose(rotation.velocity_rad_s, velocity, rtol=0.05, atol=3e-4)
        assert math.degrees(rotation.sd_rad_s) == pytest.approx(1.0, rel=0.05)
    # as that of their neighbours: nothing changes from frame to frame
    for end in (rotations[0], rotations[-1]):
        assert np.allclose(end.velocity_rad_s, velocity, rtol=0.05, atol=5e-4)
        assert math.degrees(end.sd_rad_s) == pytest.approx(1.0, rel=0.05)


def test_a_fast_flight_is_not_drawn_towards_rest() -> None:
    """At 16 m/s and 28 m, 4 % of 33°/s: distances were 0.07 % too long, all of them."""
    velocity = np.array([math.radians(33.0), 0.0, 0.0])
    time_s = np.linspace(0.0, 2.75, 12)
    sight = Rotation.from_rotvec(time_s[:, None] * velocity).apply([0.0, -16.0, 28.0])
    attitude: FloatArray = np.tile(np.eye(3), (12, 1, 1))
    for rotation in rotations_between_frames(time_s, sight, attitude, A_PRIORI):
        assert rotation.velocity_rad_s[0] == pytest.approx(velocity[0], rel=0.01)
        assert math.degrees(rotation.sd_rad_s) == pytest.approx(1.0, rel=0.05)


def test_a_lone_frame_after_a_gap_keeps_a_wide_prior() -> None:
    """Its own motion is not known, but may be as fast as that of the others."""
    velocity = np.array([math.radians(33.0), 0.0, 0.0])
    time_s = np.append(np.linspace(0.0, 2.75, 12), 20.0)
    sight = Rotation.from_rotvec(time_s[:, None] * velocity).apply([0.0, -16.0, 28.0])
    attitude: FloatArray = np.tile(np.eye(3), (13, 1, 1))
    lone = rotations_between_frames(time_s, sight, attitude, A_PRIORI)[-1]
    assert not any(lone.velocity_rad_s)
    assert math.degrees(lone.sd_rad_s) == pytest.approx(33.0 / math.sqrt(3.0), rel=0.1)


def test_places_show_what_the_cameras_own_rates_do_not() -> None:
    """A camera that flies on and turns: both together are the rotation of the scene."""
    turn_rad_s = np.array([0.03, -0.05, 0.02])
    enu_from_camera = Rotation.from_rotvec(TIME_S[:, None] * turn_rad_s).as_matrix()
    sight_m = np.array([3.0, 4.0, -25.0]) - TIME_S[:, None] * [1.5, -0.5, 0.0]
    plate: FloatArray = np.tile(np.eye(3), (10, 1, 1))
    camera_from_enu = np.swapaxes(enu_from_camera, 1, 2)
    in_camera_m = np.einsum("nij,nj->ni", camera_from_enu, sight_m)
    total = rotations_between_frames(TIME_S, in_camera_m, camera_from_enu, A_PRIORI)
    parts = rotations_by_places(TIME_S, sight_m, enu_from_camera, plate, A_PRIORI)
    for row in range(1, 9):
        own = -camera_from_enu[row] @ turn_rad_s
        both = own + parts[row].velocity_rad_s
        assert both == pytest.approx(np.array(total[row].velocity_rad_s), abs=0.005)
        assert np.linalg.norm(parts[row].velocity_rad_s) > 0.05
        assert parts[row].sd_rad_s < 0.3 * total[row].sd_rad_s


def test_unpredictable_frames_leave_the_a_priori_rotation() -> None:
    rotations = rotations_between_frames(TIME_S, *turning(np.zeros(3), wobble_rad=0.5), A_PRIORI)
    for rotation in rotations[1:-1]:
        assert np.linalg.norm(rotation.velocity_rad_s) < A_PRIORI.sd_rad_s
        assert 0.9 * A_PRIORI.sd_rad_s < rotation.sd_rad_s <= A_PRIORI.sd_rad_s


def test_deviations_are_those_of_a_restless_camera() -> None:
    """Errors of a wobbling camera's rates agree with the deviations from neighbours."""
    wobble_rad = 0.01
    rotations = rotations_between_frames(TIME_S, *turning(np.zeros(3), wobble_rad), A_PRIORI)
    off = [np.array(rotation.velocity_rad_s) / rotation.sd_rad_s for rotation in rotations[1:-1]]
    assert 0.3 < math.sqrt(np.mean(np.square(off))) < 1.3


def test_few_frames_leave_the_a_priori_rotation() -> None:
    sight, attitude = turning(np.array([0.1, 0.0, 0.0]))
    few = slice(0, 6)
    rotations = rotations_between_frames(TIME_S[few], sight[few], attitude[few], A_PRIORI)
    assert rotations == [A_PRIORI] * 6


def test_the_better_known_of_two_rotations_is_used() -> None:
    rates, frames = SceneRotation((0.1, 0.0, -0.2), 0.02), SceneRotation((0.2, 0.0, 0.0), 0.01)
    assert more_certain(rates, frames) is frames
    assert more_certain(frames, rates) is frames
    assert more_certain(rates, None) is rates


def test_velocity_and_rotation_of_a_camera_follow_from_its_poses() -> None:
    """In any order of the frames; without times, what is known before remains."""
    velocity_m_s, turn_rad_s = np.array([7.0, -2.0, 0.5]), np.array([0.03, -0.05, 0.02])
    enu_from_camera = Rotation.from_rotvec(TIME_S[:, None] * turn_rad_s).as_matrix()
    centre_m = TIME_S[:, None] * velocity_m_s
    order = np.random.default_rng(3).permutation(len(TIME_S))
    time_s = TIME_S[order]
    time_s[order == 9] = math.nan
    rate = SceneRotation((0.1, 0.2, -0.3), math.radians(0.5))
    rates = [rate if row in {0, 9} else None for row in order]
    motions = camera_motions(time_s, centre_m[order], enu_from_camera[order], rates, A_PRIORI, 25.0)
    for row, place in enumerate(order):
        if 0 < place < 9:
            assert motions.is_observed[row]
            assert motions.velocity_m_s[row] == pytest.approx(velocity_m_s, rel=0.01)
            assert motions.sd_velocity_m_s[row] == pytest.approx(0.087, rel=0.05)
            assert motions.turn_rad_s[row] == pytest.approx(turn_rad_s, rel=0.05)
            assert motions.sd_turn_rad_s[row] == pytest.approx(math.radians(1.0), rel=0.05)
        elif place == 9:
            assert not motions.is_observed[row]
            assert not motions.velocity_m_s[row].any()
            assert motions.sd_velocity_m_s[row] == pytest.approx(25.0 * A_PRIORI.sd_rad_s)
        else:
            assert motions.velocity_m_s[row] == pytest.approx(velocity_m_s, rel=0.01)
        if place in {0, 9}:  # the camera rotates opposite to the scene
            turn = -enu_from_camera[place] @ rate.velocity_rad_s
            assert motions.turn_rad_s[row] == pytest.approx(turn)
            assert motions.sd_turn_rad_s[row] == rate.sd_rad_s


def test_orientations_move_on_until_a_row() -> None:
    motions = CameraMotions(
        np.array([[8.0, 0.0, 1.0]]),
        np.array([0.2]),
        np.array([[0.0, 0.0, 0.5]]),
        np.array([0.02]),
        np.array([True]),
    )
    poses = ExteriorOrientations(
        np.zeros((1, 3)), np.eye(3)[None], None, states_centres=False, states_angles=False
    )
    moved = motions.after(poses, [0, 0], np.array([0.01, -0.01]))
    np.testing.assert_allclose(moved.centre_m, [[0.08, 0.0, 0.01], [-0.08, 0.0, -0.01]])
    turned = Rotation.from_matrix(moved.enu_from_camera).as_rotvec()
    np.testing.assert_allclose(turned[:, 2], [0.005, -0.005], rtol=1e-6)
    assert moved.cov is not None
    sds = np.sqrt(np.diagonal(moved.cov, axis1=1, axis2=2))
    np.testing.assert_allclose(sds, [[0.002] * 3 + [0.0002] * 3] * 2)
