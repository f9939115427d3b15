"""The blurred disc against the noncentral χ² distribution, which shares no code with it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import ncx2

from kgcp.geometry.arrays import FloatArray
from kgcp.target.quadrature import Quadrature, quadrature_for
from kgcp.target.rendering import chord_profile, edge_profile, normal

CHORDS = [rule for rule in Quadrature if rule is not Quadrature.EDGE]


def isotropic(rho: FloatArray, radius: float, sigma: float) -> FloatArray:
    """1 − Q₁: the exact profile of a disc under isotropic Gaussian blur."""
    return np.asarray(ncx2.cdf((radius / sigma) ** 2, 2, (rho / sigma) ** 2))


def disc(
    x: FloatArray,
    radius: float,
    blur: tuple[float, float, float],
    rule: Quadrature,
    y: float = 0.0,
    smear: float = 0.0,
) -> FloatArray:
    """Value and derivatives, (7, n); blur along, across, mixed."""
    return np.array([chord_profile(at, y, radius, *blur, smear, int(rule)) for at in x.tolist()]).T


def edge(
    rho: FloatArray, radius: float, radial: float, tangential: float, smear: float
) -> FloatArray:
    profiles = [edge_profile(r, radius, radial, tangential, smear) for r in rho.tolist()]
    return np.array(profiles).T


def test_the_normal_distribution() -> None:
    z = np.linspace(-9.0, 9.0, 2001)
    below, density = np.array([normal(value) for value in z.tolist()]).T
    np.testing.assert_allclose(below, ndtr(z), rtol=0.0, atol=2e-9)
    expected = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    np.testing.assert_allclose(density, expected, rtol=0.0, atol=1e-8)


def rule_for(ratio_whole: float, ratio_sigma: float) -> Quadrature:
    return Quadrature(quadrature_for(np.array([ratio_whole]), np.array([ratio_sigma]))[0])


@settings(deadline=None)
@given(ratio=st.floats(0.1, 60.0), sigma=st.floats(0.3, 3.0))
def test_every_disc_is_the_noncentral_chi_square(ratio: float, sigma: float) -> None:
    radius = ratio * sigma
    rho = np.linspace(max(1e-3, radius - 4.0 * sigma), radius + 4.0 * sigma, 41)
    rule = rule_for(ratio, ratio)
    if rule is Quadrature.EDGE:
        level = edge(rho, radius, sigma**2, sigma**2, 0.0)[0]
    else:
        level = disc(rho, radius, (sigma**2, sigma**2, 0.0), rule)[0]
    assert np.abs(level - isotropic(rho, radius, sigma)).max() < 4e-4


@pytest.mark.parametrize("rule", CHORDS)
@pytest.mark.parametrize("argument", range(6))
@pytest.mark.parametrize("smear", [0.0, 3.0])
def test_derivatives_are_those_of_the_value(rule: Quadrature, argument: int, smear: float) -> None:
    if argument == 5 and smear == 0.0:
        return  # a streak's length cannot be negative
    radius = (0.7, 1.5, 2.5, 5.0, 8.0, 20.0)[rule]
    x = np.linspace(max(0.05, radius - 2.5), radius + 2.5, 31)
    base = [0.0, 0.4, 0.8, 1.3, 0.25, smear]

    def at(step: float) -> FloatArray:
        values = [value + step * (number == argument) for number, value in enumerate(base)]
        along, across, mixed = values[2:5]
        return disc(x + values[0], radius, (along, across, mixed), rule, values[1], values[5])

    numeric = (at(1e-5)[0] - at(-1e-5)[0]) / 2e-5
    assert np.allclose(numeric, at(0.0)[1 + argument], atol=3e-6)


@pytest.mark.parametrize(("radius", "length"), [(2.0, 4.0), (3.5, 9.0), (9.0, 12.0), (20.0, 30.0)])
def test_a_streak_is_the_mean_of_shifted_discs(radius: float, length: float) -> None:
    """Against the noncentral χ² distribution, averaged over the exposure."""
    sigma = 0.7
    whole = np.hypot(sigma, length / np.sqrt(12.0))
    rule = rule_for(radius / whole, radius / sigma)
    assert rule is not Quadrature.EDGE
    shifts = length * ((np.arange(600) + 0.5) / 600 - 0.5)
    for y in (0.0, 0.6 * radius, 0.97 * radius, radius + sigma):
        x = np.linspace(0.0, radius + 0.5 * length + 2.0, 25)
        rho = np.hypot(x[:, None] + shifts, y)
        expected = isotropic(rho, radius, sigma).mean(axis=1)
        level = disc(x, radius, (sigma**2, sigma**2, 0.0), rule, y, length)[0]
        assert np.abs(level - expected).max() < 4e-4


def test_anisotropic_blur_against_random_shifts() -> None:
    """A disc shifted by random blur: the share of shifts that cover a point is its level."""
    rng = np.random.default_rng(5)
    covariance = np.array([[0.9, 0.5], [0.5, 1.6]])
    shifts = rng.multivariate_normal(np.zeros(2), covariance, size=400_000)
    radius = 2.2
    rule = rule_for(2.2 / np.sqrt(1.6), 2.2 / np.sqrt(1.6))
    for rho in (0.5, 1.8, 2.4, 3.5):
        covered = np.hypot(rho + shifts[:, 0], shifts[:, 1]) <= radius
        expected = covered.mean()
        level = disc(np.array([rho]), radius, (0.9, 1.6, 0.5), rule)[0, 0]
        assert abs(level - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / len(shifts))


@pytest.mark.parametrize("smear", [0.0, 0.4, 3.0, 9.0])
def test_a_smeared_edge_is_the_mean_of_shifted_ones(smear: float) -> None:
    shifts = (np.arange(2000) + 0.5) / 2000 - 0.5
    for rho in np.linspace(12.0, 28.0, 33).tolist():
        mean = edge(rho + smear * shifts, 20.0, 0.9, 1.4, 0.0)[0].mean()
        assert edge(np.array([rho]), 20.0, 0.9, 1.4, smear)[0, 0] == pytest.approx(mean, abs=1e-6)


@pytest.mark.parametrize("smear", [0.8, 4.0])
@pytest.mark.parametrize("argument", range(4))
def test_derivatives_of_the_smeared_edge(smear: float, argument: int) -> None:
    rho = np.linspace(15.0, 25.0, 41)

    def at(step: float) -> FloatArray:
        values = [0.0, 0.9, 1.4, smear]
        values[argument] += step
        return edge(rho + values[0], 20.0, values[1], values[2], values[3])

    numeric = (at(1e-5)[0] - at(-1e-5)[0]) / 2e-5
    assert np.allclose(numeric, at(0.0)[1 + argument], atol=1e-6)
