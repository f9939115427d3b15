"""Curves of few harmonics against a plain version, one at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.search.harmonic_curves import (
    TERMS,
    fill_in_medians,
    fit_curves,
    waves_of,
)

WIDTHS = np.array((0.25, 0.12, 0.07))


def angles_rad(rays: int) -> FloatArray:
    return np.asarray(2.0 * np.pi / rays * np.arange(rays, dtype=np.float64))


def harmonics_of(rays: int) -> FloatArray:
    angles = angles_rad(rays)
    waves = [f(k * angles) for k in (1, 2) for f in (np.cos, np.sin)]
    return np.column_stack([np.ones(rays), *waves])


def fitted(
    edges: FloatArray, strengths: GreyArray, start: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    curves, residuals = np.zeros((TERMS, edges.shape[1])), np.empty(edges.shape)
    curves[0] = start
    fit_curves(edges, strengths, waves_of(len(edges)), WIDTHS, curves, residuals)
    return curves, residuals


@pytest.mark.parametrize(("rays", "count"), [(20, 1), (20, 64), (20, 150), (40, 65)])
def test_each_curve_equals_weighted_least_squares(rays: int, count: int) -> None:
    rng = np.random.default_rng(rays + count)
    edges = 1.0 + 0.1 * rng.normal(size=(rays, count))
    strengths = rng.integers(0, 256, (rays, count)).astype(np.uint8)
    harmonics = harmonics_of(rays)
    curves, residuals = fitted(edges, strengths)
    for i in range(count):
        share = np.minimum(strengths[:, i] / (np.median(strengths[:, i]) + 1e-6), 1.0)
        plain, off = np.zeros(TERMS), edges[:, i] - 1.0
        for width in WIDTHS:
            weights = share / (1.0 + (off / width) ** 2) ** 2
            normal = harmonics.T @ (weights[:, None] * harmonics) + 1e-3 * np.eye(TERMS)
            plain = np.linalg.solve(normal, harmonics.T @ (weights * edges[:, i]))
            off = edges[:, i] - harmonics @ plain
        np.testing.assert_allclose(curves[:, i], plain, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(residuals[:, i], off, rtol=0.0, atol=1e-9)


def test_a_third_of_wrong_edges_hardly_moves_a_curve() -> None:
    rng = np.random.default_rng(5)
    true = np.array([1.02, 0.05, -0.03, 0.04, 0.02])
    edges = np.tile((harmonics_of(40) @ true)[:, None], 100)
    for column in edges.T:
        wrong = rng.choice(40, 13, replace=False)
        column[wrong] = rng.uniform(0.6, 1.6, 13)
    curves, _ = fitted(edges, np.full(edges.shape, 90, np.uint8))
    off = np.abs(harmonics_of(40) @ (curves - true[:, None])).max(axis=0)
    assert 0.0 < np.median(off) < 0.01
    assert np.mean(off < 0.05) >= 0.9


def test_zero_curves_are_accepted() -> None:
    curves, residuals = fitted(np.empty((20, 0)), np.empty((20, 0), np.uint8))
    assert curves.shape == (TERMS, 0)
    assert residuals.shape == (20, 0)


def test_edges_of_zero_strength_give_a_zero_curve() -> None:
    curves, _ = fitted(np.full((20, 3), 1.1), np.zeros((20, 3), np.uint8))
    np.testing.assert_allclose(curves, 0.0, atol=1e-12)


@given(arrays.arrays(np.uint8, st.tuples(st.sampled_from((2, 20, 40)), st.integers(1, 70))))
def test_medians_equal_numpy(values: GreyArray) -> None:
    medians = np.empty(values.shape[1])
    fill_in_medians(values, medians)
    np.testing.assert_array_equal(medians, np.median(values, axis=0))
