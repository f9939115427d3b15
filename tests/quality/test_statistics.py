from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.quality.statistics import Spread, moving_statistics, wilson_interval


def test_the_spread_of_known_numbers_is_right() -> None:
    spread = Spread.of(np.array([1.0, 2.0, 3.0, 6.0]))
    assert (spread.count, spread.mean) == (4, 3.0)
    assert spread.sd == pytest.approx(math.sqrt(14.0 / 3.0))
    assert spread.rms == pytest.approx(math.sqrt(50.0 / 4.0))
    assert spread.sd_mean == pytest.approx(math.sqrt(14.0 / 12.0))
    assert Spread.of(np.array([2.0])).sd is None


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (8, 10, 0.490, 0.943),  # tabulated by Newcombe (1998) and others
        (0, 10, 0.0, 0.278),
        (10, 10, 0.722, 1.0),
        (81, 263, 0.2553, 0.3662),  # Newcombe's first example
        (1807, 2134, 0.8309, 0.8614),  # the paper's 84.7 %
    ],
)
def test_wilson_intervals_agree_with_published_ones(
    successes: int, trials: int, low: float, high: float
) -> None:
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-3)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_intervals_solve_their_equation(case: tuple[int, int]) -> None:
    successes, trials = case
    rate = successes / trials
    low, high = wilson_interval(successes, trials)
    assert 0.0 <= low <= rate <= high <= 1.0
    for end in (low, high):
        if 0.0 < end < 1.0:
            assert (rate - end) ** 2 == pytest.approx(1.96**2 * end * (1 - end) / trials, rel=1e-3)


def test_wilson_intervals_refuse_impossible_counts() -> None:
    with pytest.raises(ValueError, match="3 successes in 2 trials"):
        wilson_interval(3, 2)


def test_moving_statistics_are_those_of_each_window() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(10.0, 100.0, 300)
    y = 0.01 * x + rng.normal(0.0, 0.2, 300)
    moving = moving_statistics(x, y, 10.0)
    at_60 = int(np.argmin(np.abs(moving.centre - 60.0)))
    inside = y[np.abs(x - 60.0) <= 5.0]
    assert moving.mean[at_60] == pytest.approx(inside.mean())
    assert moving.sd[at_60] == pytest.approx(inside.std(ddof=1))
    assert moving.mean[at_60] == pytest.approx(0.6, abs=0.2)


def test_windows_with_too_few_values_stay_empty() -> None:
    moving = moving_statistics(
        np.array([10.0, 10.5, 11.0, 60.0]), np.array([1.0, 2.0, 3.0, 9.0]), 10
    )
    at_35 = int(np.argmin(np.abs(moving.centre - 35.0)))
    assert np.isnan(moving.mean[at_35])
    assert np.isnan(moving.mean[-1])
    assert moving.mean[0] == pytest.approx(2.0)
