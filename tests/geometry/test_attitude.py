"""The vertical in the camera frame, against the map it comes from."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, down_in_camera, rotation_from_opk
from kgcp.georef.local_frame import LocalFrame


@pytest.mark.parametrize(
    ("crs", "origin"),
    [
        ("EPSG:25832", (905_000.0, 5_336_208.0, 545.0)),  # its grid north is 4° off there
        ("EPSG:3035", (2_950_000.0, 3_100_000.0, 120.0)),  # equal-area: not even true to angles
        ("EPSG:4258", (11.5, 48.1, 560.0)),
    ],
)
def test_down_is_the_local_vertical_in_any_map_frame(crs: str, origin: tuple[float, ...]) -> None:
    opk_deg = np.array([[3.0, -8.0, 71.0], [-12.0, 1.0, -160.0]])
    local_frame = LocalFrame.at(crs, np.array(origin))
    camera_from_enu = CAMERA_FROM_PHOTO @ np.swapaxes(
        local_frame.grid_rotation(np.zeros(3)) @ rotation_from_opk(opk_deg), 1, 2
    )
    expected = camera_from_enu @ np.array([0.0, 0.0, -1.0])
    assert np.allclose(down_in_camera(opk_deg), expected, atol=1e-8)


def test_down_is_the_optical_axis_of_a_nadir_camera() -> None:
    assert np.allclose(down_in_camera(np.array([[0.0, 0.0, 137.0]])), [[0.0, 0.0, 1.0]])
