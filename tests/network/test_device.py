"""EO devices: identification of points; symmetric devices and misfitting discs are refused."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ground.orient import DEVICE_M, measure_devices
from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.device import orient_by_device, require_distinct
from kgcp.network.ground.resection import NoPoseError

CAMERA = Camera(4000, 3000, 3000.0, 3000.0, 1999.5, 1499.5)
SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])


def test_points_are_identified_without_a_known_focal_length() -> None:
    assert "right permutation in 100.00 % of 2, 0 wrong" in measure_devices(2, seed=1)


@pytest.mark.parametrize(
    "points",
    [
        np.vstack((SQUARE, [[0.5, 0.5, 0.4]])),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.8, 0.0], [0.5, 0.3, 0.0]]),
    ],
)
def test_symmetric_devices_are_refused(points: FloatArray) -> None:
    with pytest.raises(SettingError, match="looks the same with its points"):
        require_distinct(points)


def test_a_mirror_image_is_no_symmetry_of_a_device_with_a_raised_point() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.8, 0.0], [0.5, 0.3, 0.5]])
    require_distinct(points)
    require_distinct(DEVICE_M)
    with pytest.raises(SettingError, match="farther than 1000 m"):
        require_distinct(1e306 * points)
    with pytest.raises(SettingError, match="exchanged"):
        require_distinct(0.0 * points)
    with pytest.raises(SettingError, match="3 points; give 4 to 8"):
        require_distinct(points[:3])


def test_images_that_fit_no_or_two_permutations_give_no_pose() -> None:
    camera = Camera(1600, 1200, 2300.0, 2300.0, 799.5, 599.5)
    pixels = np.array([[700.0, 500.0], [900.0, 500.0], [900.0, 700.0], [700.0, 700.0]])
    cov = np.repeat(np.eye(2)[None], 4, axis=0)
    with pytest.raises(NoPoseError, match="fit alike"):
        orient_by_device(camera, SQUARE, pixels, cov)


def device_images(points_m: FloatArray, rng: np.random.Generator, sd_px: float) -> FloatArray:
    """Return images of a device, turned at random, 2 m before a tilted camera."""
    tilt = rotation_about(np.array([0.3, -0.2, 0.0]))
    turn = rotation_about(np.array([0.0, 0.0, rng.uniform(0.0, 6.0)]))
    in_camera = points_m @ (tilt @ turn @ np.diag((1.0, -1.0, -1.0))).T + (0.1, 0.1, 2.0)
    return CAMERA.project(in_camera) + sd_px * rng.standard_normal((len(points_m), 2))


@pytest.mark.parametrize(
    "built",
    [
        DEVICE_M * (1.0, -1.0, 1.0),
        DEVICE_M * (1.0, 1.0, -1.0),
        DEVICE_M[:, [1, 0, 2]],
        DEVICE_M * (1.1, 1.0, 1.0),
    ],
    ids=["y the other way", "z the other way", "x and y exchanged", "too long"],
)
def test_a_device_that_differs_from_its_description_gives_no_pose(built: FloatArray) -> None:
    rng = np.random.default_rng(1)
    cov = np.repeat(0.02**2 * np.eye(2)[None], len(built), axis=0)
    reasons = []
    for _ in range(6):
        with pytest.raises(NoPoseError) as caught:
            orient_by_device(CAMERA, DEVICE_M, device_images(built, rng, 0.02), cov)
        reasons.append(str(caught.value))
    # in other frames, two permutations fit alike
    assert any("the discs do not fit the device (RMS" in reason for reason in reasons)


def test_residuals_larger_than_stated_enlarge_the_deviations() -> None:
    rng = np.random.default_rng(1)
    stated = np.repeat(0.01**2 * np.eye(2)[None], len(DEVICE_M), axis=0)
    sd_m = []
    for sd_px in (0.01, 0.2):
        poses = [
            orient_by_device(CAMERA, DEVICE_M, device_images(DEVICE_M, rng, sd_px), stated)
            for _ in range(6)
        ]
        sd_m.append(np.median([np.sqrt(np.trace(pose.cov[:3, :3])) for pose in poses]))
    assert 8.0 < sd_m[1] / sd_m[0] < 30.0
