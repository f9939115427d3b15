"""The blurred disc against the noncentral χ² distribution, which shares no code with it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ncx2

from kgcp.geometry.arrays import FloatArray
from kgcp.target.bent_edge import edge_coordinate, edge_level, smeared_edge, still_edge
from kgcp.target.profile import (
    Coverage,
    Quadrature,
    blurred_disc,
    blurred_level,
    quadrature_for,
)


def isotropic(rho: FloatArray, radius: float, sigma: float) -> FloatArray:
    """1 − Q₁: the exact profile of a disc under isotropic Gaussian blur."""
    return np.asarray(ncx2.cdf((radius / sigma) ** 2, 2, (rho / sigma) ** 2))


@settings(deadline=None)
@given(ratio=st.floats(0.1, 60.0), sigma=st.floats(0.3, 3.0))
def test_every_disc_is_the_noncentral_chi_square(ratio: float, sigma: float) -> None:
    radius = ratio * sigma
    rho = np.linspace(max(1e-3, radius - 4.0 * sigma), radius + 4.0 * sigma, 41)
    radii, variance = np.full_like(rho, radius), np.full_like(rho, sigma**2)
    rule = quadrature_for(ratio)
    if rule is Quadrature.EDGE:
        coverage = still_edge(edge_coordinate(rho, radii, variance, variance))
    else:
        coverage = blurred_disc(rho, radii, variance, variance, 0.0 * rho, rule)
    assert np.abs(coverage.value - isotropic(rho, radius, sigma)).max() < 4e-4


def disc(arguments: list[FloatArray], rule: Quadrature) -> Coverage:
    rho, radius, radial, tangential, mixed = arguments
    return blurred_disc(rho, radius, radial, tangential, mixed, rule)


@pytest.mark.parametrize("rule", [rule for rule in Quadrature if rule is not Quadrature.EDGE])
@pytest.mark.parametrize("argument", range(5))
def test_derivatives_are_those_of_the_value(rule: Quadrature, argument: int) -> None:
    radius = {0: 0.7, 1: 1.5, 2: 2.5, 3: 5.0}[rule]
    rho = np.linspace(max(0.05, radius - 2.5), radius + 2.5, 31)
    one = np.ones_like(rho)
    base = [rho, radius * one, 0.8 * one, 1.3 * one, 0.25 * one]
    coverage = disc(base, rule)
    analytic = {
        0: coverage.d_rho,
        2: coverage.d_var_radial,
        3: coverage.d_var_tangential,
        4: coverage.d_covariance,
    }
    if argument == 1:
        rho, radii, radial, tangential, mixed = base
        level = blurred_level(rho, radii, radial, tangential, mixed, rule)
        assert np.allclose(level, coverage.value, atol=1e-12)
        return
    step = 1e-5
    high, low = ([*base] for _ in range(2))
    high[argument] = base[argument] + step
    low[argument] = base[argument] - step
    numeric = (disc(high, rule).value - disc(low, rule).value) / (2.0 * step)
    assert np.allclose(numeric, analytic[argument], atol=2e-6)


def test_anisotropic_blur_against_random_shifts() -> None:
    """A disc shifted by random blur: the share of shifts that cover a point is its level."""
    rng = np.random.default_rng(5)
    covariance = np.array([[0.9, 0.5], [0.5, 1.6]])
    shifts = rng.multivariate_normal(np.zeros(2), covariance, size=400_000)
    radius = 2.2
    for rho in (0.5, 1.8, 2.4, 3.5):
        covered = np.hypot(rho + shifts[:, 0], shifts[:, 1]) <= radius
        expected = covered.mean()
        one = np.ones(1)
        level = blurred_disc(
            rho * one,
            radius * one,
            0.9 * one,
            1.6 * one,
            0.5 * one,
            quadrature_for(radius / np.sqrt(1.6)),
        ).value[0]
        assert abs(level - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / len(shifts))


@pytest.mark.parametrize("smear", [0.0, 0.4, 3.0, 9.0])
def test_a_smeared_edge_is_the_mean_of_shifted_ones(smear: float) -> None:
    radius, shifts = 20.0, (np.arange(2000) + 0.5) / 2000 - 0.5
    rho = np.linspace(12.0, 28.0, 60)
    radii, radial, tangential = (np.full_like(rho, value) for value in (radius, 0.9, 1.4))
    mean = np.mean(
        [
            still_edge(edge_coordinate(rho + smear * shift, radii, radial, tangential)).value
            for shift in shifts
        ],
        axis=0,
    )
    at = edge_coordinate(rho, radii, radial, tangential)
    coverage, _ = smeared_edge(at, np.full_like(rho, smear))
    assert np.allclose(coverage.value, mean, atol=1e-6)
    assert np.allclose(edge_level(at, np.full_like(rho, smear)), coverage.value, atol=1e-12)


@pytest.mark.parametrize("smear", [0.8, 4.0])
@pytest.mark.parametrize("argument", range(4))
def test_derivatives_of_the_smeared_edge(smear: float, argument: int) -> None:
    rho = np.linspace(15.0, 25.0, 41)

    def at(step: float) -> tuple[Coverage, FloatArray]:
        values = [rho, *(np.full_like(rho, value) for value in (0.9, 1.4, smear))]
        values[argument] = values[argument] + step
        radii = np.full_like(rho, 20.0)
        return smeared_edge(edge_coordinate(values[0], radii, values[1], values[2]), values[3])

    coverage, d_smear = at(0.0)
    analytic = (coverage.d_rho, coverage.d_var_radial, coverage.d_var_tangential, d_smear)
    numeric = (at(1e-5)[0].value - at(-1e-5)[0].value) / 2e-5
    assert np.allclose(numeric, analytic[argument], atol=1e-6)
