"""Rays of two cameras over the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.quality.frame_rays import compare_cameras, ray_deviations_px

CAMERA = Camera(1600, 1200, 3000.0, 3000.0, 803.0, 598.0, -0.1, 0.05)


def test_a_camera_does_not_differ_from_itself() -> None:
    assert compare_cameras(CAMERA, CAMERA).largest_px < 1e-6


def test_a_longer_lens_moves_rays_outwards() -> None:
    difference = compare_cameras(CAMERA, replace(CAMERA, fx=3003.0, fy=3003.0))
    outwards = 0.001 * (difference.pixels - [803.0, 598.0])
    assert np.abs(difference.shifts_px - outwards).max() < 0.05
    assert difference.largest_px == pytest.approx(1.0, abs=0.05)


def test_a_rotation_absorbs_most_of_a_shift_of_the_principal_point() -> None:
    difference = compare_cameras(CAMERA, replace(CAMERA, cx=808.0))
    assert 0.05 < difference.rms_px < 0.6


def test_ray_deviations_equal_the_differences_of_a_changed_parameter() -> None:
    """One parameter is uncertain: rays move as they do for a camera with another value of it."""
    cov = CalibrationCovariance.of(("k1",), np.array([[0.001**2]]))
    foretold = ray_deviations_px(CAMERA, cov).ravel()
    difference = compare_cameras(CAMERA, replace(CAMERA, k1=CAMERA.k1 + 0.001))
    assert np.allclose(foretold, np.linalg.norm(difference.shifts_px, axis=1), rtol=0.01, atol=1e-4)
