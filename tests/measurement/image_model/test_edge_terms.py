"""Skew point spreads, and light across edges, against sums over the tenths of a disc's pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blur import EdgeIncidence
from kgcp.measurement.image_model.edge_terms import skew_rows, spread_share_gradient
from kgcp.measurement.image_model.ray_plate import plate_views

Light = Callable[[FloatArray, FloatArray], FloatArray]
_RADIUS_PX = 8.0
_POSE = np.hstack((np.eye(3), [[0.0], [0.0], [1.0]]))  # a metre is a pixel


def _around_the_edge(out_px: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.outer(out_px, np.cos(angles)).ravel(), np.outer(out_px, np.sin(angles)).ravel()


def _views(x: FloatArray, y: FloatArray) -> FloatArray:
    rays = np.zeros((6, len(x)))
    rays[0], rays[1], rays[2], rays[5] = x, y, 1.0, 1.0
    return plate_views(_POSE, rays)


def _incidence(count: int) -> EdgeIncidence:
    circle = np.array([[0.0, 0.0, _RADIUS_PX, 1.0, 0.0]])
    return EdgeIncidence(circle, np.array([0, count]), np.arange(count), np.zeros(count))


def _even(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.ones_like(x * y)


def _blurred_disc(
    x: FloatArray, y: FloatArray, covariance: FloatArray, light: Light = _even
) -> FloatArray:
    """Blur what a disc sends back of the light, by a Gaussian."""
    step = 0.1
    line = np.arange(-_RADIUS_PX, _RADIUS_PX, step) + 0.5 * step
    u, v = np.meshgrid(line, line)
    inside = u * u + v * v < _RADIUS_PX * _RADIUS_PX
    u, v = u[inside], v[inside]
    (xx, xy), (_, yy) = np.linalg.inv(covariance)
    dx, dy = x[:, None] - u, y[:, None] - v
    weights = np.exp(-0.5 * (xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy))
    weights *= light(u, v) / (2.0 * np.pi * np.sqrt(np.linalg.det(covariance)))
    return np.asarray(weights.sum(axis=1) * step * step)


def test_third_moments_displace_edges_as_two_gaussians_do() -> None:
    """Two Gaussians beside each other have κ_xxx = p (1 − p)(1 − 2p) d³ about their centroid."""
    share, shift_px = 0.2, 1.0  # a fifth of the light lands one pixel beside
    each = 1.2**2 * np.eye(2)
    x, y = _around_the_edge(np.array([6.5, 7.5, 8.0, 8.5, 9.5]), 16)
    near, far = -share * shift_px, (1.0 - share) * shift_px
    truth = (1.0 - share) * _blurred_disc(x - near, y, each) + share * _blurred_disc(
        x - far, y, each
    )
    variance = share * (1.0 - share) * shift_px**2
    cumulant = variance * (1.0 - 2.0 * share) * shift_px
    spread = (each[0, 0] + variance, each[1, 1], 0.0)
    rows = skew_rows(_views(x, y), spread, _incidence(len(x)))
    # the part odd in x is due to the skew, all else to the spread's variance
    opposite = np.array([np.argmin((x + a) ** 2 + (y - b) ** 2) for a, b in zip(x, y, strict=True)])
    odd = 0.5 * (truth - truth[opposite])
    modelled = cumulant * rows[0]
    assert np.abs(odd).max() > 0.003
    assert np.abs(modelled - odd).max() < 0.2 * np.abs(odd).max()


def test_third_derivatives_follow_the_curvature_of_edges_in_oblique_views() -> None:
    """At 50°, contours are bent with radii of 3.3 to 12.4 px in the image of this disc of 8 px."""
    sd_px, foreshortening, step = 1.2, np.cos(np.radians(50.0)), 0.1
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    normals = np.stack((np.cos(angles), np.sin(angles) / foreshortening))
    normals /= np.hypot(*normals)
    contour = _RADIUS_PX * np.stack((np.cos(angles), foreshortening * np.sin(angles)))
    out_px = sd_px * np.array([-1.5, -0.7, 0.0, 0.7, 1.5])
    x, y = (contour[:, None] + out_px[:, None] * normals[:, None]).reshape(2, -1)
    rays = np.zeros((6, len(x)))
    rays[0], rays[1], rays[2], rays[5] = x, y / foreshortening, 1.0, 1.0 / foreshortening
    rows = skew_rows(plate_views(_POSE, rays), (sd_px**2, sd_px**2, 0.0), _incidence(len(x)))

    line = np.arange(-_RADIUS_PX, _RADIUS_PX, step) + 0.5 * step
    u, v = np.meshgrid(line, foreshortening * line)
    inside = u**2 + (v / foreshortening) ** 2 < _RADIUS_PX**2
    dx, dy = (x[:, None] - u[inside]) / sd_px, (y[:, None] - v[inside]) / sd_px
    weights = np.exp(-0.5 * (dx * dx + dy * dy)) * step**2 * foreshortening
    weights /= 2.0 * np.pi * sd_px**5
    hermite = (
        dx**3 - 3.0 * dx,
        3.0 * (dx**2 - 1.0) * dy,
        3.0 * dx * (dy**2 - 1.0),
        dy**3 - 3.0 * dy,
    )
    for row, polynomial in zip(rows, hermite, strict=True):
        truth = np.sum(weights * polynomial, axis=1) / 6.0
        assert np.abs(row - truth).max() < 0.25 * np.abs(truth).max()


def test_light_across_an_edge_is_blurred_with_it() -> None:
    light_left, width_px, offset_px = 0.45, 2.0, 6.5  # of a shadow across the disc
    normal = np.array((np.cos(0.6), np.sin(0.6)))
    covariance = np.array([[0.9, 0.15], [0.15, 0.6]])
    blurred_px = np.sqrt(width_px**2 + normal @ covariance @ normal)

    def across_px(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(normal[0] * x + normal[1] * y - offset_px)

    def light(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(1.0 - (1.0 - light_left) * ndtr(across_px(x, y) / width_px))

    x, y = _around_the_edge(np.array([7.0, 7.5, 8.0, 8.5, 9.0]), 24)
    z = across_px(x, y) / blurred_px
    blurred_light = 1.0 - (1.0 - light_left) * ndtr(z)
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) / blurred_px
    gradient = np.outer(normal, -(1.0 - light_left) * density)
    spread = spread_share_gradient(_views(x, y), (0.9, 0.6, 0.15), _incidence(len(x)))
    truth = _blurred_disc(x, y, covariance, light)
    product = blurred_light * _blurred_disc(x, y, covariance)
    missed = truth - (product + np.sum(gradient * spread, axis=0))
    assert 0.03 < np.abs(truth - product).max() < 0.06
    assert np.abs(missed).max() < 0.2 * np.abs(truth - product).max()
