"""Projections at a frame's edges, against which cameras of every format are compared."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera

# Corners of a frame of 1600 x 1100 px, the middle of its upper edge and its own middle.
EDGES_PX = np.array(
    [[-0.5, -0.5], [1599.5, -0.5], [1599.5, 1099.5], [-0.5, 1099.5], [799.5, -0.5], [799.5, 549.5]]
)
DEPTHS = np.array([[1.0], [2.5], [80.0], [0.7], [3.0], [11.0]])


@pytest.fixture(scope="session")
def check() -> Callable[[Camera, Callable[[FloatArray], FloatArray]], None]:
    """Compare with a formula that gives pixels from the centre of the top-left one."""

    def compare(camera: Camera, expected_px: Callable[[FloatArray], FloatArray]) -> None:
        normalised = camera.undistort(EDGES_PX)
        assert np.isfinite(normalised).all()
        points = np.hstack((normalised, np.ones((6, 1)))) * DEPTHS
        np.testing.assert_allclose(camera.project(points), EDGES_PX, rtol=0, atol=1e-6)
        np.testing.assert_allclose(expected_px(points), EDGES_PX, rtol=0, atol=1e-6)

    return compare


@pytest.fixture(scope="session")
def brown() -> Callable[[FloatArray, tuple[float, ...], tuple[float, float]], FloatArray]:
    """Return distorted coordinates by the formula of OpenCV's documentation."""

    def distort(points: FloatArray, k: tuple[float, ...], p: tuple[float, float]) -> FloatArray:
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        r2 = x**2 + y**2
        radial = 1 + sum(value * r2 ** (order + 1) for order, value in enumerate(k))
        return np.column_stack(
            (
                x * radial + 2 * p[0] * x * y + p[1] * (r2 + 2 * x**2),
                y * radial + p[0] * (r2 + 2 * y**2) + 2 * p[1] * x * y,
            )
        )

    return distort
