from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.spikes import check_spikes

START_S = 1_781_597_700.0


def driven(time_s: FloatArray) -> FloatArray:
    """Round bends of 12 m radius at 9 m/s, with 7 m/s² across, on a road that goes up and down."""
    angle = 9.0 / 12.0 * time_s
    return np.column_stack((12.0 * np.cos(angle), 12.0 * np.sin(angle), 2.0 * np.sin(time_s)))


def motion(time_s: FloatArray, position_m: FloatArray, sd_m: float | None = 0.01) -> Motion:
    turns = np.broadcast_to(np.eye(3), (len(time_s), 3, 3)).copy()
    sd = None if sd_m is None else np.full_like(position_m, sd_m)
    return Motion(START_S + time_s, position_m, turns, sd, None)


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0, 100.0])
@pytest.mark.parametrize("jump_m", [30.0, 100.0])
@pytest.mark.parametrize("sd_m", [0.01, None])
def test_one_epoch_that_jumps_is_named(rate_hz: float, jump_m: float, sd_m: float | None) -> None:
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    position_m = driven(time_s)
    row = int(np.searchsorted(time_s, 20.0))
    position_m[row, 2] += jump_m
    (doubt,) = check_spikes(motion(time_s, position_m, sd_m))
    assert (doubt.code, doubt.is_grave) == (Cause.TRAJECTORY_SPIKE, False)
    assert "2026-06-16 08:15:20 UTC" in doubt.sentence
    assert doubt.figures["jump_m"] == pytest.approx(jump_m, abs=5.0)
    assert doubt.figures["epochs"] == 1.0


def test_all_epochs_that_jump_are_counted() -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    position_m = driven(time_s)
    position_m[[100, 300, 400], 0] += [5.0, -30.0, 8.0]
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert "lies 30.0 m from" in doubt.sentence
    assert "2 others less far" in doubt.sentence


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0])
@pytest.mark.parametrize("epochs", [2, 3, 20])
@pytest.mark.parametrize("sd_m", [0.01, None])
def test_a_run_that_jumps_and_returns_is_named(
    rate_hz: float, epochs: int, sd_m: float | None
) -> None:
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    position_m = driven(time_s)
    row = int(np.searchsorted(time_s, 20.0))
    position_m[row : row + epochs] += [3.0, -2.0, 4.0]
    (doubt,) = check_spikes(motion(time_s, position_m, sd_m))
    assert f"the {epochs} epochs from 2026-06-16 08:15:20 to" in doubt.sentence
    assert "m from those before and after them:" in doubt.sentence
    assert doubt.figures["jump_m"] == pytest.approx(np.sqrt(29.0), abs=1.0)
    assert doubt.figures["epochs"] == float(epochs)


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0])
@pytest.mark.parametrize("epochs", [1, 2, 3])
@pytest.mark.parametrize("at_end", [False, True])
def test_wrong_first_and_last_epochs_are_named(
    rate_hz: float, epochs: int, *, at_end: bool
) -> None:
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    position_m = driven(time_s)
    position_m[slice(-epochs, None) if at_end else slice(epochs)] += [0.0, 6.0, 0.0]
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert ("from those before" if at_end else "from those after") in doubt.sentence
    assert "before and after" not in doubt.sentence
    assert doubt.figures["jump_m"] == pytest.approx(6.0, abs=1.0)
    assert doubt.figures["epochs"] == float(epochs)


def test_single_epochs_and_runs_are_counted_together() -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    position_m = driven(time_s)
    position_m[[50, 200], 0] += 8.0
    position_m[300:305, 1] -= 5.0
    position_m[-2:, 2] += 4.0
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert "the epoch of 2026-06-16 08:15:" in doubt.sentence
    assert "8 others less far" in doubt.sentence
    assert doubt.figures["epochs"] == 9.0


def test_paths_of_normal_drives_raise_no_doubt() -> None:
    for rate_hz in (1.0, 2.0, 5.0, 20.0, 100.0):
        time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
        assert not [*check_spikes(motion(time_s, driven(time_s)))]
        gap = (time_s < 20.0) | (time_s > 27.0)  # half a circle later
        assert not [*check_spikes(motion(time_s[gap], driven(time_s[gap])))]
        braked = np.minimum(time_s, 30.0)  # from 9 m/s to 0 at once
        noise = 1e-3 * np.random.default_rng(4).standard_normal((len(time_s), 3))
        assert not [*check_spikes(motion(time_s, driven(braked) + noise))]
    assert not [*check_spikes(motion(np.array([0.0, 1.0]), np.zeros((2, 3))))]


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0])
@pytest.mark.parametrize(("noise_m", "sd_m"), [(2.0, 2.0), (2.0, None), (2.0, 0.01), (0.3, 0.05)])
def test_noise_raises_no_doubt(rate_hz: float, noise_m: float, sd_m: float | None) -> None:
    time_s = np.arange(0.0, 600.0, 1.0 / rate_hz)
    noise = np.random.default_rng(4).normal(0.0, noise_m, (len(time_s), 3))
    assert not [*check_spikes(motion(time_s, driven(time_s) + noise, sd_m))]


@pytest.mark.parametrize("rate_hz", [10.0, 20.0, 100.0])
@pytest.mark.parametrize("jump_m", [0.5, 4.0])
def test_a_jump_to_another_solution_is_doubted_if_deviations_are_small(
    rate_hz: float, jump_m: float
) -> None:
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    position_m = driven(time_s)
    position_m[time_s >= 30.0] += np.array([jump_m, 0.0, 0.0])
    position_m[time_s < 2.0] += np.array([0.0, jump_m, 0.0])
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert (doubt.code, doubt.is_grave) == (Cause.TRAJECTORY_SPIKE, False)
    assert "UTC, and goes on from there, and at 1 other place less far" in doubt.sentence
    assert doubt.figures["jump_m"] == pytest.approx(jump_m, abs=0.1)
    assert not [*check_spikes(motion(time_s, position_m, 1.0))]  # a float solution, as stated


def test_jumps_without_deviations_and_coarse_numbers_raise_no_doubt() -> None:
    time_s = np.arange(0.0, 60.0, 0.1)
    position_m = driven(time_s)
    coarse = np.round(position_m / 1.1) * 1.1
    assert not [*check_spikes(motion(time_s, coarse, None))]
    assert not [*check_spikes(motion(time_s, coarse))]  # the positions scatter: another doubt
    position_m[300:] += np.array([4.0, 0.0, 0.0])
    assert not [*check_spikes(motion(time_s, position_m, None))]


def test_stops_and_turns_about_raise_no_doubt() -> None:
    rng = np.random.default_rng(6)
    for rate_hz in (1.0, 5.0, 20.0):
        time_s = np.arange(0.0, 120.0, 1.0 / rate_hz)
        there = np.minimum(time_s, 60.0) - np.maximum(time_s - 60.0, 0.0)  # and back, at once
        position_m = np.column_stack((4.0 * there, 0.0 * time_s, 0.0 * time_s))
        noisy = position_m + rng.normal(0.0, 0.02, position_m.shape)
        assert not [*check_spikes(motion(time_s, noisy))]
        stands = np.abs(np.mod(time_s, 30.0) - 20.0) < 5.0
        progress = 5.0 * np.cumsum(~stands) / rate_hz  # from 5 m/s to 0 at once, four times
        position_m = np.column_stack((progress, 0.0 * time_s, 0.0 * time_s))
        noisy = position_m + rng.normal(0.0, 0.001, position_m.shape)
        assert not [*check_spikes(motion(time_s, noisy))]


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0, 100.0])
def test_a_repeated_position_is_no_stop(rate_hz: float) -> None:
    """A vehicle brakes first, and may then stand at exactly one place."""
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    (doubt,) = check_spikes(motion(time_s, driven(np.minimum(time_s, 30.0))))
    assert doubt.code == Cause.TRAJECTORY_SPIKE
    assert doubt.is_grave
    assert "from 2026-06-16 08:15:30 UTC on" in doubt.sentence
    assert doubt.figures["lasts_s"] == pytest.approx(29.5, abs=0.51)
    brakes_s = 9.0 / 5.0  # at 5 m/s²
    since_s = np.clip(time_s - 30.0, 0.0, brakes_s)
    braked = np.minimum(time_s, 30.0) + since_s - since_s**2 / (2.0 * brakes_s)
    assert not [*check_spikes(motion(time_s, driven(braked)))]


def test_float_solutions_with_their_deviations_raise_no_doubt() -> None:
    time_s = np.arange(0.0, 120.0, 0.2)
    position_m = driven(time_s)
    sd_m = np.full_like(position_m, 0.01)
    floats = (time_s < 0.5) | ((time_s > 60.0) & (time_s < 66.0))
    position_m[floats] += [3.0, -2.0, 4.0]
    assert [*check_spikes(motion(time_s, position_m))]
    sd_m[floats] = 1.0
    turns = np.broadcast_to(np.eye(3), (len(time_s), 3, 3)).copy()
    assert not [*check_spikes(Motion(time_s, position_m, turns, sd_m, None))]


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("gap_s", [0.0, 3.0])
def test_a_jump_to_another_vehicle_or_height_is_grave(rate_hz: float, gap_s: float) -> None:
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    time_s[time_s >= 20.0] += gap_s
    position_m = driven(time_s)
    position_m[time_s >= 20.0] += [0.0, 300.0, 0.0]
    position_m[time_s >= 50.0] += [0.0, 0.0, 130.0]
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert (doubt.code, doubt.is_grave) == (Cause.TRAJECTORY_SPIKE, True)
    # in a gap, the drive adds to the jump
    assert doubt.figures["jump_m"] == pytest.approx(300.0, abs=25.0)
    assert doubt.figures["jumps"] == 2.0
    assert "UTC, and goes on from there, and at 1 other place less far" in doubt.sentence


def test_a_gap_that_no_vehicle_crosses_in_time_is_grave() -> None:
    time_s = np.arange(0.0, 60.0, 0.05)
    time_s[600:] += 7200.0
    position_m = driven(time_s)
    position_m[600:, 0] += 446_000.0  # easting of the next zone
    (doubt,) = check_spikes(motion(time_s, position_m))
    assert doubt.is_grave
    assert "jumps by 446 km in 7200 s" in doubt.sentence
    position_m[600:, 0] -= 346_000.0  # 100 km: by motorway
    assert not [*check_spikes(motion(time_s, position_m))]


@pytest.mark.parametrize("apart_m", [0.3, 3.0, 500.0])
@pytest.mark.parametrize("shift_s", [0.012, 0.025])
def test_epochs_of_two_vehicles_in_turn_are_grave(apart_m: float, shift_s: float) -> None:
    time_s = np.arange(0.0, 60.0, 0.05)
    first, second = driven(time_s), driven(time_s + shift_s)
    second += [0.0, apart_m, 0.0]
    times_s = np.column_stack((time_s, time_s + shift_s)).ravel()
    (doubt,) = check_spikes(motion(times_s, np.stack((first, second), axis=1).reshape(-1, 3)))
    assert doubt.is_grave
    assert "alternate between two paths" in doubt.sentence
    assert doubt.figures["jump_m"] == pytest.approx(apart_m, rel=0.05)
