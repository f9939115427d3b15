"""Undistorting grids of pixels at once, compared with single pixels."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pixel_grid import normalised_grid, rays_of_window

CAMERA = Camera(
    width=1600,
    height=1100,
    fx=2306.0,
    fy=2302.0,
    cx=792.6,
    cy=543.9,
    k1=-0.11,
    k2=0.07,
    p1=8e-4,
    p2=-6e-4,
    k3=-0.01,
    k4=0.02,
    k5=0.01,
    k6=0.0,
)


def pixels_of(x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("x_px", "y_px"),
    [
        (np.arange(0.0, 180.0), np.arange(0.0, 131.0)),  # where distortion is strongest
        (np.arange(760.0, 800.0), np.arange(1060.0, 1100.0)),
        (np.arange(1599.0, 1600.0), np.arange(500.0, 503.0)),  # one column
    ],
)
def test_a_window_is_undistorted_like_its_pixels(x_px: FloatArray, y_px: FloatArray) -> None:
    rays = rays_of_window(CAMERA, x_px, y_px)
    normalised, from_px = rays[:2], rays[2:].reshape(2, 2, -1)
    pixels = pixels_of(x_px, y_px)
    exact = CAMERA.undistort(pixels)
    np.testing.assert_allclose(normalised.T * CAMERA.fx, exact * CAMERA.fx, rtol=0.0, atol=1e-9)
    step = 0.01
    for axis in (0, 1):
        shift = step * np.eye(2)[axis]
        numeric = (CAMERA.undistort(pixels + shift) - CAMERA.undistort(pixels - shift)) / 2.0 / step
        np.testing.assert_allclose(from_px[:, axis].T, numeric, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("corner_px", [(0.0, 0.0), (1500.0, 0.0), (3049.0, 2049.0)])
def test_large_windows_of_wide_lenses_are_undistorted_like_their_pixels(
    corner_px: tuple[float, float],
) -> None:
    camera = Camera(4000, 3000, 2300.0, 2300.0, 2000.0, 1500.0, k1=-0.14, k2=0.12, k3=-0.03)
    x_px, y_px = (start + np.arange(950.0) for start in corner_px)
    rays, pixels = rays_of_window(camera, x_px, y_px)[:2].T[::37], pixels_of(x_px, y_px)[::37]
    np.testing.assert_allclose(camera.distort(rays), pixels, rtol=0.0, atol=1e-6)


def test_pixels_beyond_the_fold_leave_the_rest_of_their_window_alone() -> None:
    """With k1 = -0.3 rays end 632 px from the principal point, in the corner of this window."""
    camera = Camera(2000, 1500, 900.0, 900.0, 1000.0, 750.0, k1=-0.3)
    x_px, y_px = 1400.0 + np.arange(90.0), 1150.0 + np.arange(80.0)
    rays, exact = rays_of_window(camera, x_px, y_px), camera.undistort(pixels_of(x_px, y_px))
    assert 0.5 < np.isfinite(exact).mean() < 0.95
    np.testing.assert_array_equal(rays[:2].T, exact)
    slopes = np.linalg.inv(camera.distort_jacobian(exact)).reshape(-1, 4)
    np.testing.assert_allclose(rays[2:].T, slopes, rtol=1e-9)


def test_a_whole_frame_is_undistorted_like_its_pixels() -> None:
    x_px, y_px = np.arange(-0.5, 1600.0, 40.0), np.arange(-0.5, 1100.0, 40.0)
    x, y = normalised_grid(CAMERA, x_px, y_px)
    assert x.shape == y.shape == (len(y_px), len(x_px))
    exact = CAMERA.undistort(pixels_of(x_px, y_px))
    np.testing.assert_allclose(np.column_stack((x.ravel(), y.ravel())), exact, rtol=0.0, atol=1e-9)
