"""Compiled equations of the points in a frame, against numpy and differences."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.point_equations import (
    add_products,
    fill_in_covariances,
    fill_in_derivatives,
    fill_in_residuals,
    fill_in_squares,
)

CAMERA = Camera(1600, 1200, 1700.0, 1690.0, 812.3, 590.1, k1=-0.08, k2=0.03, p1=3e-4, p2=-2e-4)
POSITIONS_M = np.array([[3.0, 4.0, 1.0], [-5.0, 2.0, 0.3], [1.0, -6.0, 2.1], [6.0, 5.0, -0.4]])
PIXELS, DISTANCES_M = np.full((4, 2), 700.0), np.array([29.0, 31.0, np.nan, 30.0])
DOWN = np.diag([1.0, -1.0, -1.0])


def covariances(rng: np.random.Generator, size: int) -> FloatArray:
    roots = rng.standard_normal((4, size, size))
    return np.asarray(roots @ np.swapaxes(roots, 1, 2) + np.eye(size))


def residuals_of(step: FloatArray, positions_m: FloatArray = POSITIONS_M) -> FloatArray:
    """Residuals (4, 3) after a step (7,) of centre, rotation and focal scale's logarithm."""
    world_from_camera = rotation_about(step[3:6]) @ DOWN
    points = (positions_m - np.array([0.5, -0.4, 30.0]) - step[:3]) @ world_from_camera
    scale, residuals = float(np.exp(step[6])), np.empty((4, 3))
    computed_px = CAMERA.distort(scale * points[:, :2] / points[:, 2:])
    fill_in_residuals(points, scale, computed_px, PIXELS, DISTANCES_M, residuals)
    return residuals


def derivatives() -> tuple[FloatArray, FloatArray]:
    arms = POSITIONS_M - np.array([0.5, -0.4, 30.0])
    points = arms @ DOWN
    normalised = points[:, :2] / points[:, 2:]
    design, by_point = np.empty((4, 3, 7)), np.empty((4, 3, 3))
    lens = CAMERA.distort_jacobian(normalised)
    fill_in_derivatives(points, normalised, lens, arms, DOWN.copy(), 1.0, design, by_point)
    return design, by_point


def test_derivatives_are_those_of_the_computed_observations() -> None:
    design, by_point = derivatives()
    for column, step in enumerate(1e-6 * np.eye(7)):
        numeric = (residuals_of(-step) - residuals_of(step)) / 2e-6
        np.testing.assert_allclose(design[:, :2, column], numeric[:, :2], rtol=1e-5, atol=1e-3)
        known = np.isfinite(DISTANCES_M)
        np.testing.assert_allclose(design[known, 2, column], numeric[known, 2], atol=1e-7)
    for axis, shift in enumerate(1e-6 * np.eye(3)):
        still = np.zeros(7)
        behind, ahead = (residuals_of(still, POSITIONS_M + sign * shift) for sign in (-1.0, 1.0))
        numeric = (behind - ahead) / 2e-6
        np.testing.assert_allclose(by_point[:, :2, axis], numeric[:, :2], rtol=1e-5, atol=1e-3)


def test_covariances_contain_those_of_the_positions() -> None:
    rng = np.random.default_rng(1)
    _, by_point = derivatives()
    of_positions, of_pixels, sds = covariances(rng, 3), covariances(rng, 2), rng.uniform(0.1, 1, 4)
    cov = np.empty((4, 3, 3))
    fill_in_covariances(by_point, of_positions, of_pixels, DISTANCES_M, sds, cov)
    expected = by_point @ of_positions @ np.swapaxes(by_point, 1, 2)
    expected[:, :2, :2] += of_pixels
    expected[:, 2, 2] += (sds / DISTANCES_M) ** 2
    known = np.isfinite(DISTANCES_M)
    np.testing.assert_allclose(cov[known], expected[known], rtol=1e-12)
    np.testing.assert_allclose(cov[~known, :2, :2], expected[~known, :2, :2], rtol=1e-12)
    assert not cov[~known, 2, :2].any()  # a distance that is not measured says nothing
    assert cov[~known, 2, 2].min() > 1e9


def test_squares_and_products_are_those_of_whitened_equations() -> None:
    rng = np.random.default_rng(2)
    cov, residuals = covariances(rng, 3), rng.standard_normal((4, 3))
    design, common = rng.standard_normal((4, 3, 7)), rng.standard_normal((4, 3, 2))
    weights, squares, products = rng.uniform(0.1, 1.0, 4), np.empty(4), np.zeros((9, 9))
    residuals[2, 2] = np.nan
    rows = np.concatenate((design[:, :, :6], np.nan_to_num(residuals)[..., None], common), axis=2)
    assert fill_in_squares(residuals, cov, squares)
    assert add_products(6, design, residuals, common, cov, weights, products)
    weighted = np.linalg.solve(cov, rows)
    np.testing.assert_allclose(
        squares, np.einsum("nm,nm->n", rows[:, :, 6], weighted[:, :, 6]), rtol=1e-11
    )
    expected = np.einsum("n,nmp,nmq->pq", weights, rows, weighted)
    np.testing.assert_allclose(products, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("row", [0, 2])
def test_a_singular_covariance_is_told(row: int) -> None:
    cov = np.tile(np.eye(3), (4, 1, 1))
    cov[1, row, row] = 0.0
    assert not fill_in_squares(np.ones((4, 3)), cov, np.empty(4))
