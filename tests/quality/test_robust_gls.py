from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.bias_causes import holm
from kgcp.quality.robust_gls import (
    ErrorModel,
    find_outliers,
    fit,
    separable_unknowns,
    two_sided_probability,
    whitened_products,
    with_shared_errors,
)
from kgcp.quality.statistics import fit_slope


def markov(rng: np.random.Generator, time_s: FloatArray, tau_s: float) -> FloatArray:
    """A first-order Gauss-Markov process of unit variance."""
    cov = np.exp(-np.abs(time_s[:, None] - time_s) / tau_s)
    return np.linalg.cholesky(cov) @ rng.standard_normal(len(time_s))


def test_independent_noise_gives_ordinary_least_squares() -> None:
    rng = np.random.default_rng(1)
    design = np.column_stack((np.ones(80), rng.normal(size=80)))
    sd = rng.uniform(0.5, 2.0, 80)
    observed = design @ [3.0, -2.0] + sd * rng.standard_normal(80)
    found = fit(design, observed, ErrorModel(sd**2, np.zeros(80), np.arange(80.0)))
    rows, right = design / sd[:, None], observed / sd
    expected, rest, *_ = np.linalg.lstsq(rows, right, rcond=None)
    np.testing.assert_allclose(found.values, expected, rtol=1e-10)
    np.testing.assert_allclose(found.cov, np.linalg.inv(rows.T @ rows) * rest[0] / 78, rtol=1e-10)
    assert found.chi2 == pytest.approx(rest[0])
    assert found.chi2_of([0, 1]) == pytest.approx(rest[0])
    without = np.linalg.lstsq(rows[:, :1], right, rcond=None)[1][0]
    assert found.chi2_of([0]) == pytest.approx(without)


def test_deviations_are_those_of_the_scatter_where_errors_last() -> None:
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        time_s = np.cumsum(rng.uniform(0.5, 2.5, 70))
        x = np.exp(rng.uniform(2.0, 4.6, 70))
        own = 0.002 + 2e-5 * x
        lasting = 0.015 * markov(rng, time_s, 20.0)
        observed = 0.001 * x + 0.03 + own * rng.standard_normal(70) + lasting
        design = np.column_stack((x, np.ones(70)))
        stated = ErrorModel((3.0 * own) ** 2, np.full(70, 0.045**2), time_s)  # 3 times too large
        found = fit(design, observed, stated)
        errors.append((found.values - [0.001, 0.03]) / found.sds)
    scatter = np.std(errors, axis=0)
    assert np.all((scatter > 0.8) & (scatter < 1.3))
    assert np.mean(np.abs(errors) < 2.0) > 0.88


def test_lasting_errors_are_distinguished_from_independent_ones() -> None:
    rng = np.random.default_rng(7)
    time_s = np.arange(300.0)
    one, ones = np.ones((300, 1)), np.ones(300)
    noise = ErrorModel(ones, ones, time_s)
    found = fit(one, 3.0 * markov(rng, time_s, 30.0) + rng.standard_normal(300), noise)
    assert 10.0 <= found.correlation_s <= 100.0
    assert fit(one, rng.standard_normal(300), noise).correlation_s == 0.0


@pytest.mark.parametrize("dimension", [1, 3])
@pytest.mark.parametrize("tau_s", [0.0, 7.0])
def test_the_weighting_is_that_of_the_full_covariance(dimension: int, tau_s: float) -> None:
    rng = np.random.default_rng(3)
    n = 25
    time_s = np.cumsum(rng.uniform(0.2, 4.0, n))
    lasting, white = (
        half @ np.swapaxes(half, 1, 2) for half in rng.normal(size=(2, n, dimension, dimension))
    )
    white += 0.1 * np.eye(dimension)
    columns = rng.normal(size=(n, dimension, 4))
    correlation = np.eye(n)
    if tau_s:
        correlation = np.exp(-np.abs(time_s[:, None] - time_s) / tau_s)
    factor = np.linalg.cholesky(lasting)
    cov = np.einsum("ij,iab,jcb->iajc", correlation, factor, factor)
    cov[np.arange(n), :, np.arange(n)] += white
    cov = cov.reshape(n * dimension, -1)
    flat = columns.reshape(n * dimension, 4)
    products, log_det = whitened_products(columns, ErrorModel(white, lasting, time_s), tau_s)
    np.testing.assert_allclose(products, flat.T @ np.linalg.solve(cov, flat), rtol=1e-8, atol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(cov)[1], abs=1e-8)
    if dimension == 1:
        scalars = ErrorModel(white.ravel(), lasting.ravel(), time_s)
        np.testing.assert_array_equal(whitened_products(columns, scalars, tau_s)[0], products)


def test_of_inseparable_unknowns_the_last_is_left_out() -> None:
    rng = np.random.default_rng(11)
    design = rng.normal(size=(50, 4))
    design[:, 2] = design[:, 0] - 2.0 * design[:, 1] + 1e-4 * rng.normal(size=50)
    active, groups = separable_unknowns(design.T @ design, [0, 1, 2, 3], [100.0] * 4)
    assert active == [0, 1, 3]
    assert groups == [frozenset({0, 1, 2})]
    assert separable_unknowns(design.T @ design, [2, 3], [100.0] * 4) == ([2, 3], [])
    assert separable_unknowns(design.T @ design, range(4), [1e12] * 4) == ([0, 1, 2, 3], [])


def test_outliers_do_not_change_the_fit() -> None:
    rng = np.random.default_rng(5)
    x = np.linspace(10.0, 100.0, 60)
    observed = 0.02 + 0.001 * x + 0.003 * rng.standard_normal(60)
    observed[[3, 20, 21, 44, 50, 59]] += [5.0, -2.0, 0.4, 9.0, 9.0, 9.0]
    design = np.column_stack((x, np.ones(60)))
    outlier = find_outliers(design[:, None, :], observed[:, None], np.full(60, 0.01**2))
    assert np.flatnonzero(outlier).tolist() == [3, 20, 21, 44, 50, 59]
    found = fit(design, observed, ErrorModel(np.full(60, 1e-4), np.zeros(60), np.arange(60.0)))
    assert np.all(np.abs(found.values - [0.001, 0.02]) < 3.0 * found.sds)
    assert found.sds[1] < 0.002


def test_a_slope_comes_with_its_share_of_the_variance() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=2000)
    slope = fit_slope(x, 1.0 + 0.5 * x + rng.standard_normal(2000), np.ones(2000))
    assert slope is not None
    assert slope.value == pytest.approx(0.5, abs=3.0 * slope.sd_value)
    assert slope.sd_value == pytest.approx(1.0 / np.sqrt(2000.0), rel=0.05)
    assert slope.share == pytest.approx(0.25 / 1.25, abs=0.04)  # of the sum of both variances
    assert slope.probability < 1e-10
    y, sd = slope.line(np.array([slope.middle, slope.middle + 100.0]))
    assert y[1] - y[0] == pytest.approx(100.0 * slope.value)
    assert sd[1] == pytest.approx(100.0 * slope.sd_value, rel=1e-3)
    assert fit_slope(x[:5], x[:5], np.ones(5)) is None
    assert fit_slope(np.ones(9), x[:9], np.ones(9)) is None


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=9))
def test_holm_lies_between_the_single_test_and_bonferroni(probabilities: list[float]) -> None:
    corrected = holm(probabilities)
    for before, after in zip(probabilities, corrected, strict=True):
        assert before <= after <= min(1.0, len(probabilities) * before)
    for i, first in enumerate(probabilities):
        for j, second in enumerate(probabilities):
            if first < second:
                assert corrected[i] <= corrected[j]


def test_holm_and_student_agree_with_published_tables() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert two_sided_probability(2.228, 10) == pytest.approx(0.05, abs=1e-4)
    assert two_sided_probability(-3.169, 10) == pytest.approx(0.01, abs=1e-4)


def test_shared_errors_are_part_of_the_covariance() -> None:
    rng = np.random.default_rng(4)
    columns, shared = rng.standard_normal((6, 3, 4)), rng.standard_normal((6, 3, 2))
    same = np.broadcast_to(np.eye(3), (6, 3, 3))
    errors = ErrorModel(0.5 * same, 0.2 * same, np.arange(6.0))
    both = np.concatenate((columns, shared), axis=2)
    found, log_det = with_shared_errors(*whitened_products(both, errors, 0.0), 2)
    cov = 0.7 * np.eye(18) + shared.reshape(18, 2) @ shared.reshape(18, 2).T
    flat = columns.reshape(18, 4)
    np.testing.assert_allclose(found, flat.T @ np.linalg.solve(cov, flat), rtol=1e-9, atol=1e-12)
    assert log_det == pytest.approx(np.linalg.slogdet(cov)[1])
