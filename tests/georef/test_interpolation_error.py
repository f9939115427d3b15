from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.interpolation_error import interpolation_errors
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.target_positions import Vehicle
from kgcp.georef.trajectory import Motion, body_to_ned
from kgcp.settings import VehicleSettings

Drive = tuple[FloatArray, FloatArray, FloatArray]
"""Times [s], positions [m] and headings [deg]."""

_STEP_S = 0.005
_LEVER_M = np.array([-0.8, 0.15, -1.95])


def _slalom() -> Drive:
    """Return the path of a car round cones every 24 m, at 8 m/s."""
    time_s = np.arange(0.0, 240.0, _STEP_S)
    angle = 2.0 * np.pi * time_s / 6.0
    position_m = np.column_stack((8.0 * time_s, 1.5 * np.sin(angle), np.zeros_like(time_s)))
    heading_deg = np.degrees(np.arctan2(1.5 * 2.0 * np.pi / 6.0 * np.cos(angle), 8.0))
    return time_s, position_m, heading_deg


def _streets() -> Drive:
    """Return a path with right-angled turns of 12 m radius after every 6 s at 6 m/s, and stops."""
    time_s = np.arange(0.0, 240.0, _STEP_S)
    turn_s = 0.5 * np.pi * 12.0 / 6.0
    phase, number = np.mod(time_s, 6.0 + turn_s), time_s // (6.0 + turn_s)
    speed = np.where((phase < 3.0) & (number % 5.0 == 4.0), 0.0, 6.0)
    rate = np.where(phase < 6.0, 0.0, 6.0 / 12.0) * np.where(number % 3.0 == 1.0, -1.0, 1.0)
    speed, rate = (gaussian_filter1d(each, 0.4 / _STEP_S) for each in (speed, rate))
    heading = np.cumsum(rate) * _STEP_S
    rates = speed[:, None] * np.column_stack((np.cos(heading), np.sin(heading), 0.0 * heading))
    return time_s, np.cumsum(rates, axis=0) * _STEP_S, np.degrees(heading)


def _sampled(
    path: Drive, rate_hz: float, sd_m: float, sd_deg: float
) -> tuple[Motion, FloatArray, FloatArray, FloatArray]:
    """Return a path's motion by noisy epochs, and true times, positions and turns between them."""
    rng = np.random.default_rng(3)
    time_s, position_m, heading_deg = path
    epochs = np.arange(0, len(time_s), round(1.0 / (rate_hz * _STEP_S)))
    noise_m = rng.normal(0.0, sd_m, (len(epochs), 3))
    angles = rng.normal(0.0, sd_deg, (3, len(epochs)))
    motion = Motion(
        time_s[epochs],
        position_m[epochs] + noise_m,
        body_to_ned(angles[0], angles[1], heading_deg[epochs] + angles[2]),
        np.full((len(epochs), 3), sd_m),
        np.full((len(epochs), 3), sd_deg),
    )
    asked = np.sort(rng.integers(0, epochs[-1], 3000))
    turns = body_to_ned(np.zeros(len(asked)), np.zeros(len(asked)), heading_deg[asked])
    return motion, time_s[asked], position_m[asked], turns


def _standardised(error: FloatArray, cov: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(np.linalg.cholesky(cov), error[:, :, None])[:, :, 0])


@pytest.mark.parametrize("path", [_slalom, _streets])
@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0, 200.0])
@pytest.mark.parametrize(("sd_m", "sd_deg"), [(0.01, 0.05), (0.2, 1.0)])
def test_stated_deviations_agree_with_the_errors_between_epochs(
    path: Callable[[], Drive],
    rate_hz: float,
    sd_m: float,
    sd_deg: float,
) -> None:
    motion, time_s, position_m, turns = _sampled(path(), rate_hz, sd_m, sd_deg)
    errors = interpolation_errors(motion, time_s)
    states = motion.states(time_s)
    error = states.position_m - position_m
    cov = sd_m**2 * np.eye(3) + errors.cov_position_m2
    assert 0.7 < np.sqrt(np.mean(_standardised(error, cov) ** 2)) < 1.1
    off = (states.frame_from_body - turns) @ _LEVER_M
    arm = -np.cross(np.eye(3), _LEVER_M @ np.swapaxes(turns, -1, -2)[:, None, :])
    turn_cov = np.radians(sd_deg) ** 2 * np.eye(3) + errors.cov_turn_rad2
    lever_cov = arm @ turn_cov @ np.swapaxes(arm, -1, -2) + 1e-10 * np.eye(3)
    both = _standardised(error + off, cov + lever_cov)
    assert 0.7 < np.sqrt(np.mean(both**2)) < 1.1
    assert np.mean(np.abs(both) > 4.0) < 0.01


@pytest.mark.parametrize(("rate_hz", "most"), [(5.0, 0.01), (10.0, 0.003), (200.0, 0.003)])
def test_well_sampled_paths_hardly_exceed_the_deviations_of_their_epochs(
    rate_hz: float, most: float
) -> None:
    motion, time_s, _, _ = _sampled(_streets(), rate_hz, 0.01, 0.05)
    errors = interpolation_errors(motion, time_s)
    growth = np.trace(errors.cov_position_m2, axis1=1, axis2=2) / (3.0 * 0.01**2)
    assert np.mean(growth) < most
    # Without stated deviations, nothing of the noise is taken off the misfits.
    silent = replace(motion, sd_position_m=None, sd_attitude_deg=None)
    growth = np.trace(interpolation_errors(silent, time_s).cov_position_m2, axis1=1, axis2=2)
    assert np.mean(growth) / (3.0 * 0.01**2) < 0.02


def test_deviations_at_1_hz_are_large_where_errors_are() -> None:
    motion, time_s, position_m, _ = _sampled(_streets(), 1.0, 0.001, 0.01)
    errors = interpolation_errors(motion, time_s)
    sd_m = np.sqrt(np.trace(errors.cov_position_m2, axis1=1, axis2=2))
    off_m = np.linalg.norm(motion.states(time_s).position_m - position_m, axis=1)
    assert off_m.max() > 0.03
    assert np.corrcoef(sd_m, off_m)[0, 1] > 0.6


def test_nothing_is_added_at_epochs() -> None:
    motion, *_ = _sampled(_slalom(), 1.0, 0.01, 0.05)
    errors = interpolation_errors(motion, motion.time_s)
    np.testing.assert_allclose(errors.cov_position_m2, 0.0, atol=1e-20)
    np.testing.assert_allclose(errors.cov_turn_rad2, 0.0, atol=1e-20)


@pytest.mark.parametrize("epochs", [2, 3, 4, 5, 6])
def test_short_trajectories_have_errors_too(epochs: int) -> None:
    """On a circle of 20 m radius at 10 m/s; two epochs get the accelerations assumed of a car."""
    angle = 0.5 * np.arange(float(epochs))
    position_m = 20.0 * np.column_stack((np.cos(angle), np.sin(angle), np.zeros(epochs)))
    heading = body_to_ned(np.zeros(epochs), np.zeros(epochs), np.degrees(angle) + 90.0)
    motion = Motion(np.arange(float(epochs)), position_m, heading, None, None)
    time_s = np.arange(0.5, epochs - 1.0)
    errors = interpolation_errors(motion, time_s)
    sd_m = np.sqrt(np.trace(errors.cov_position_m2, axis1=1, axis2=2))
    true = 20.0 * np.column_stack((np.cos(0.5 * time_s), np.sin(0.5 * time_s), 0.0 * time_s))
    off_m = np.linalg.norm(motion.states(time_s).position_m - true, axis=1)
    assert np.all(off_m < 3.0 * sd_m)
    assert sd_m.max() < 15.0 * off_m.max()  # parabolas of two more epochs do better than lines


def test_pairs_of_close_epochs_do_not_enlarge_the_errors_of_long_steps() -> None:
    """Epochs every second and a millisecond later: noise between such two is no acceleration."""
    rng = np.random.default_rng(4)
    time_s = np.sort(np.concatenate((np.arange(0.0, 60.0), np.arange(0.0, 60.0) + 0.001)))
    position_m = np.column_stack((5.0 * time_s, np.zeros(120), np.zeros(120)))
    angles = rng.normal(0.0, 0.05, (3, 120))
    motion = Motion(
        time_s,
        position_m + rng.normal(0.0, 0.01, (120, 3)),
        body_to_ned(*angles),
        np.full((120, 3), 0.01),
        np.full((120, 3), 0.05),
    )
    errors = interpolation_errors(motion, np.arange(0.0, 59.0) + 0.5)
    sd_m = np.sqrt(np.einsum("nii->ni", errors.cov_position_m2))
    sd_deg = np.degrees(np.sqrt(np.einsum("nii->ni", errors.cov_turn_rad2)))
    assert sd_m.max() < 0.005
    assert sd_deg.max() < 0.04


def test_the_covariance_of_a_target_contains_the_error_of_interpolation() -> None:
    """It is 0 at epochs; between them, it is what the covariance exceeds that at the epochs by."""
    motion, *_ = _sampled(_slalom(), 1.0, 0.01, 0.05)
    time_s = motion.time_s[10] + np.array([0.0, 0.5])
    local_frame = LocalFrame.at("EPSG:25832", np.array([690000.0, 5336000.0, 500.0]))
    vehicle = Vehicle(motion, VehicleSettings((-0.8, 0.15, -1.95)), local_frame)
    at_epoch, between = vehicle.positions(time_s)
    assert at_epoch.interpolation_m2 is not None
    np.testing.assert_allclose(at_epoch.interpolation_m2, 0.0, atol=1e-20)
    assert between.interpolation_m2 is not None
    assert between.cov_m2 is not None
    assert 0.02 < np.sqrt(np.trace(between.interpolation_m2)) < 0.2
    own = np.sqrt(np.trace(between.cov_m2 - between.interpolation_m2))
    assert own == pytest.approx(np.sqrt(3.0) * 0.01, rel=0.03)
    silent = Vehicle(replace(motion, sd_position_m=None), vehicle.settings, local_frame)
    assert silent.positions(time_s)[1].interpolation_m2 is None
