from __future__ import annotations

import math

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.trajectory import Coverage, Motion, body_to_ned


def _circle(time_s: FloatArray, speed: float = 10.0, radius: float = 20.0) -> FloatArray:
    angle = speed / radius * time_s
    height = 0.1 * time_s
    return np.column_stack((radius * np.cos(angle), radius * np.sin(angle), height))


def _headings(heading_deg: FloatArray) -> FloatArray:
    return body_to_ned(np.zeros_like(heading_deg), np.zeros_like(heading_deg), heading_deg)


def _motion(time_s: FloatArray, position_m: FloatArray) -> Motion:
    return Motion(time_s, position_m, _headings(np.zeros_like(time_s)), None, None)


def test_body_axes_point_where_a_surveyor_expects() -> None:
    east_bound = body_to_ned(np.array(0.0), np.array(0.0), np.array(90.0))
    np.testing.assert_allclose(east_bound[:, 0], [0.0, 1.0, 0.0], atol=1e-15)  # forward: east
    np.testing.assert_allclose(east_bound[:, 1], [-1.0, 0.0, 0.0], atol=1e-15)  # right: south
    nose_up = body_to_ned(np.array(0.0), np.array(10.0), np.array(0.0))
    assert nose_up[2, 0] == pytest.approx(-math.sin(math.radians(10.0)))  # forward rises
    right_down = body_to_ned(np.array(10.0), np.array(0.0), np.array(0.0))
    assert right_down[2, 1] == pytest.approx(math.sin(math.radians(10.0)))  # right side sinks


def test_angles_apply_in_the_order_heading_pitch_roll() -> None:
    roll, pitch, heading = (math.radians(a) for a in (5.0, -7.0, 130.0))
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    ch, sh = math.cos(heading), math.sin(heading)
    written_out = [
        [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
        [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
        [-sp, cp * sr, cp * cr],
    ]
    rotation = body_to_ned(np.array([5.0]), np.array([-7.0]), np.array([130.0]))[0]
    np.testing.assert_allclose(rotation, written_out, atol=1e-14)


@pytest.mark.parametrize(("rate_hz", "tolerance_m"), [(1.0, 0.06), (10.0, 1e-5), (100.0, 1e-7)])
def test_a_turn_is_followed_between_samples(rate_hz: float, tolerance_m: float) -> None:
    start = 1.7e9  # Unix time costs 0.2 µs of resolution, 2 µm at 10 m/s
    time_s = np.arange(0.0, 20.0, 1.0 / rate_hz)
    motion = _motion(start + time_s, _circle(time_s))
    wanted = np.linspace(time_s[0], time_s[-1], 201)
    states = motion.states(start + wanted)
    error = np.linalg.norm(states.position_m - _circle(wanted), axis=1)
    assert error.max() < max(tolerance_m, 5e-6)
    np.testing.assert_allclose(np.linalg.norm(states.velocity_m_s, axis=1), 10.0, atol=0.5)


def test_noise_over_a_short_interval_causes_no_oscillation() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.201, 0.3, 0.4])
    position = np.column_stack((10.0 * time_s, np.zeros(6), [0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    states = _motion(time_s, position).states(np.array([0.05, 0.25]))
    np.testing.assert_allclose(states.position_m[:, 0], [0.5, 2.5], atol=1e-12)
    assert 0.0 <= states.position_m[1, 2] <= 0.01
    np.testing.assert_allclose(states.velocity_m_s[:, 0], 10.0)


@pytest.mark.parametrize(
    ("time_s", "tolerance_m"),
    [
        pytest.param(np.append(0.7, np.arange(1.0, 60.0)), 0.06, id="a late first epoch"),
        pytest.param(np.append(np.arange(0.0, 60.0), 59.01), 0.06, id="an early last epoch"),
        pytest.param(np.sort(np.append(np.arange(0.0, 60.0), 30.3)), 0.06, id="one epoch more"),
        pytest.param(np.sort(np.append(np.arange(0.0, 60.0), 30.001)), 0.06, id="an epoch twice"),
        pytest.param(
            np.delete(np.arange(0.0, 60.0, 0.05), range(600, 608)), 1e-3, id="eight epochs fewer"
        ),
    ],
)
def test_unevenly_spaced_epochs_do_not_flatten_a_turn(
    time_s: FloatArray, tolerance_m: float
) -> None:
    """A straight chord is 0.62 m off at 1 Hz, and 0.13 m over 0.45 s."""
    wanted = np.linspace(time_s[0], time_s[-1], 1201)
    states = _motion(time_s, _circle(time_s)).states(wanted)
    error = np.linalg.norm(states.position_m - _circle(wanted), axis=1)
    assert error.max() < tolerance_m
    np.testing.assert_allclose(np.linalg.norm(states.velocity_m_s, axis=1), 10.0, atol=0.5)


@pytest.mark.parametrize("rate_hz", [10.0, 100.0])
def test_noise_beside_a_gap_is_not_amplified_in_the_gap(rate_hz: float) -> None:
    time_s = np.arange(0.0, 20.0, 1.0 / rate_hz)
    time_s = time_s[np.abs(time_s - 10.0) > 0.19]
    noise_m = np.random.default_rng(5).normal(0.0, 0.01, (len(time_s), 3))
    wanted = np.linspace(9.81, 10.19, 50)
    states = _motion(time_s, _circle(time_s) + noise_m).states(wanted)
    error = states.position_m - _circle(wanted)
    assert np.abs(error).max() < 0.03


def test_the_path_goes_through_every_sample() -> None:
    rng = np.random.default_rng(7)
    time_s = np.cumsum(rng.uniform(0.01, 0.2, 200))
    position_m = _circle(time_s) + rng.normal(0.0, 0.01, (200, 3))
    states = _motion(time_s, position_m).states(time_s)
    np.testing.assert_allclose(states.position_m, position_m, atol=1e-9)


def test_heading_takes_the_short_way_through_north() -> None:
    time_s = np.array([0.0, 1.0])
    motion = Motion(time_s, np.zeros((2, 3)), _headings(np.array([350.0, 20.0])), None, None)
    states = motion.states(np.array([0.5]))
    forward = states.frame_from_body[0, :, 0]
    assert math.degrees(math.atan2(forward[1], forward[0])) == pytest.approx(5.0)
    np.testing.assert_allclose(states.angular_velocity_rad_s[0], [0.0, 0.0, math.radians(30.0)])


def test_times_outside_the_trajectory_or_in_a_gap_are_named() -> None:
    time_s = np.concatenate((np.arange(0.0, 1.0, 0.1), np.arange(3.0, 4.0, 0.1)))
    motion = _motion(time_s, _circle(time_s))
    asked = np.array([-0.1, 0.0, 0.55, 0.9, 2.0, 3.0, time_s[-1], 4.5])
    assert motion.coverage(asked) == [
        Coverage.BEFORE,
        Coverage.INSIDE,
        Coverage.INSIDE,
        Coverage.INSIDE,  # the last sample before the gap itself
        Coverage.GAP,
        Coverage.INSIDE,
        Coverage.INSIDE,
        Coverage.AFTER,
    ]


def test_a_gap_does_not_bend_the_track_beside_it() -> None:
    time_s = np.concatenate((np.arange(0.0, 1.0, 0.1), np.arange(30.0, 31.0, 0.1)))
    motion = _motion(time_s, _circle(time_s))
    states = motion.states(np.array([0.85, 30.05]))
    np.testing.assert_allclose(states.position_m, _circle(np.array([0.85, 30.05])), atol=1e-4)


def test_the_epochs_beside_a_gap_have_the_velocity_of_their_own_side() -> None:
    time_s = np.concatenate((np.arange(0.0, 1.0, 0.1), np.arange(30.0, 31.0, 0.1)))
    heading_deg = np.where(time_s < 15.0, 90.0 * time_s, 0.0)
    motion = Motion(time_s, _circle(time_s), _headings(heading_deg), None, None)
    states = motion.states(time_s[[0, 9, 10, 19]])
    np.testing.assert_allclose(states.position_m, _circle(time_s[[0, 9, 10, 19]]), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(states.velocity_m_s, axis=1), 10.0, atol=0.1)
    turn_deg_s = np.degrees(states.angular_velocity_rad_s[:, 2])
    np.testing.assert_allclose(turn_deg_s, [90.0, 90.0, 0.0, 0.0], atol=1e-6)


def test_a_slow_logger_is_no_gap() -> None:
    time_s = np.arange(0.0, 10.0, 1.0)
    motion = _motion(time_s, _circle(time_s))
    assert motion.max_gap_s == pytest.approx(1.5)
    assert motion.coverage(np.array([4.5])) == [Coverage.INSIDE]


def test_standard_deviations_are_interpolated() -> None:
    sd = np.array([[0.01, 0.01, 0.02], [0.03, 0.01, 0.04]])
    motion = Motion(np.array([0.0, 1.0]), np.zeros((2, 3)), _headings(np.zeros(2)), sd, None)
    states = motion.states(np.array([0.5]))
    assert states.sd_position_m is not None
    np.testing.assert_allclose(states.sd_position_m, [[0.02, 0.01, 0.03]])
    assert states.sd_attitude_deg is None
