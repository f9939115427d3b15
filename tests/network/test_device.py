"""EO devices: which point is which, symmetric ones refused."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.ground.orient import DEVICE_M, measure_devices
from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.network.ground.device import orient_by_device, require_distinct
from kgcp.network.ground.resection import NoPoseError

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])


def test_points_are_told_apart_though_the_focal_length_is_not_known() -> None:
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
