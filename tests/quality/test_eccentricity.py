"""Eccentricity in numbers: known formulas, and what neglecting it does to a focal length."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D
from kgcp.quality.eccentricity import (
    displacement_over_frame,
    eccentricity_over_angle,
    parameters_if_neglected,
    summarise_eccentricity,
)

CAMERA = Camera(1200, 800, 1500.0, 1500.0, 590.0, 410.0, -0.2)


def test_eccentricity_over_the_angle_follows_the_formula() -> None:
    angles_deg, px = eccentricity_over_angle(CAMERA, 20.0)
    expected = 20.0**2 / 1500.0 * 0.5 * np.sin(np.radians(2.0 * angles_deg))
    assert px == pytest.approx(expected, abs=2e-3 * expected.max())


def test_distortion_within_the_marker_grows_with_the_square_of_the_radius() -> None:
    """And towards the corners: it is the curvature of the distortion, times R²."""
    places, small = displacement_over_frame(CAMERA, 10.0)
    _, large = displacement_over_frame(CAMERA, 20.0)
    assert large == pytest.approx(4.0 * small, abs=1e-3 * float(np.abs(large).max()))
    length = np.linalg.norm(large, axis=1)
    out = np.linalg.norm(places - [590.0, 410.0], axis=1)
    assert np.corrcoef(length, out)[0, 1] > 0.99
    assert displacement_over_frame(Camera(1200, 800, 1500.0, 1500.0, 590.0, 410.0), 20.0)[
        1
    ] == pytest.approx(0.0, abs=1e-9)


def test_the_summary_of_a_view_has_medians_and_largest_values() -> None:
    tilt = np.radians(30.0)
    centres = np.array([[0.0, 0.0, 1.0], [0.2, 0.1, 1.0]])
    normals = np.array([[np.sin(tilt), 0.0, np.cos(tilt)], [0.0, 0.0, 1.0]])
    circles = Circles3D.with_normals(centres, normals, np.array([0.01, 0.01]))
    summary = summarise_eccentricity(CAMERA, circles)
    assert summary.focal_px == pytest.approx(1500.0)
    assert summary.tilt_deg.largest == pytest.approx(30.0, abs=1e-6)
    assert summary.tilt_deg.median == pytest.approx(0.5 * (30.0 + 12.6), abs=0.1)
    assert summary.radius_px.largest == pytest.approx(15.0, rel=0.05)
    assert summary.perspective_px.largest == pytest.approx(0.065, abs=0.01)
    assert 0.0 < summary.in_marker_px.median < summary.in_marker_px.largest < 0.05


def test_neglected_shifts_change_the_parameters_that_imitate_them() -> None:
    rng = np.random.default_rng(0)
    jacobian, weights = rng.normal(size=(40, 3)) * [1.0, 1e4, 1e-3], rng.uniform(1.0, 2.0, 40)
    change = np.array([0.1, -2e-5, 30.0])
    assert parameters_if_neglected(jacobian, weights, jacobian @ change) == pytest.approx(change)
