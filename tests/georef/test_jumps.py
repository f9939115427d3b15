from __future__ import annotations

import numpy as np

from kgcp.georef.jumps import find_jumps


def test_jumps_are_found_and_nothing_else_is() -> None:
    rng = np.random.default_rng(7)
    time_s = 1.5 * np.arange(300.0) + rng.uniform(-0.3, 0.3, 300)
    smooth = 60.0 + 15.0 * np.sin(0.05 * time_s)
    noisy = smooth + 0.02 * rng.standard_normal(300)
    wrong = [40, 120, 130, 250]
    noisy[wrong] += [0.5, -0.5, 0.5, 3.0]
    jumps = find_jumps(time_s, noisy, np.full(300, 0.02))
    assert np.flatnonzero(jumps).tolist() == wrong


def test_false_flags_are_rare_whatever_the_stated_deviation() -> None:
    rng = np.random.default_rng(8)
    time_s = 1.5 * np.arange(4000.0)
    noise = 0.02 * rng.standard_normal(4000)
    for stated in (0.0, 0.002, 0.02):  # five deviations of a normal one: 6e-7
        assert find_jumps(time_s, noise, np.full(4000, stated)).sum() <= 1


def test_a_turbulent_flight_has_no_jumps() -> None:
    rng = np.random.default_rng(9)
    time_s = 1.5 * np.arange(300.0)
    gusty = 60.0 + 3.0 * rng.standard_normal(300)  # metres, with deviations of centimetres
    assert not find_jumps(time_s, gusty, np.full(300, 0.02)).any()


def test_a_turn_from_climb_to_descent_is_no_jump() -> None:
    rng = np.random.default_rng(10)
    time_s = 1.5 * np.arange(100.0)
    for turn_s in (75.0, 75.4, 76.0):
        height = 80.0 - 2.0 * np.abs(time_s - turn_s) + 0.02 * rng.standard_normal(100)
        assert not find_jumps(time_s, height, np.full(100, 0.02)).any()


def test_ends_gaps_and_isolated_values_are_never_flagged() -> None:
    time_s = np.concatenate((np.arange(10.0), 100.0 + np.arange(10.0), [500.0]))
    value = np.zeros(21)
    value[[0, 9, 10, 19, 20]] = 5.0
    assert not find_jumps(time_s, value, np.full(21, 0.01)).any()
    assert not find_jumps(time_s[:0], value[:0], value[:0]).any()
