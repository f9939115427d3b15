"""Windows cut out of frames: levels, borders and the lens."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.window import Window, contour_px, cut_window, semi_major_axis_px

PlacePlate = Callable[..., Pose]
RADIUS_M, MARGIN_PX = 0.45, 5.0


def numbered_frame(camera: Camera) -> GreyArray:
    return np.arange(camera.width * camera.height, dtype=np.uint32).reshape(camera.height, -1)


def cut_plate(frame: GreyArray, camera: Camera, pose: Pose) -> Window:
    return cut_window(frame, camera, contour_px(camera, pose, RADIUS_M), MARGIN_PX)


def test_a_window_holds_the_circle_and_its_margin(camera: Camera, place_plate: PlacePlate) -> None:
    pose = place_plate((151.3, 222.8), 31.0, tilt_deg=25.0, way_deg=70.0)
    frame = numbered_frame(camera)
    window = cut_plate(frame, camera, pose)
    contour = contour_px(camera, pose, RADIUS_M)
    first = np.array([window.x0, window.y0])
    last = first + np.array([window.width - 1, window.height - 1])
    for gap in (contour.min(axis=0) - first, last - contour.max(axis=0)):
        assert np.all((gap >= MARGIN_PX) & (gap < MARGIN_PX + 1.0))
    counts = np.rint(window.levels / window.levels_per_count).astype(np.uint32)
    rows = slice(window.y0, window.y0 + window.height)
    columns = slice(window.x0, window.x0 + window.width)
    np.testing.assert_array_equal(counts.reshape(window.height, -1), frame[rows, columns])


def test_pixels_and_rays_belong_together(camera: Camera, place_plate: PlacePlate) -> None:
    pose = place_plate((401.0, 72.0), 20.0)
    window = cut_plate(numbered_frame(camera), camera, pose)
    chosen = np.array([0, 1, window.width, 7 * window.width + 3])
    pixels = window.pixels(chosen)
    np.testing.assert_array_equal(pixels[:, 3], [window.x0 + 3, window.y0 + 7])
    np.testing.assert_allclose(camera.distort(window.rays[:2, chosen].T), pixels.T, atol=1e-8)


@pytest.mark.parametrize(("dtype", "full"), [(np.uint8, 255), (np.uint16, 65535)])
def test_levels_are_shares_of_the_range(
    camera: Camera, place_plate: PlacePlate, dtype: type, full: int
) -> None:
    frame: GreyArray = np.full((camera.height, camera.width), full, dtype)
    frame[::2] = 1
    window = cut_plate(frame, camera, place_plate((240.0, 180.0), 20.0))
    assert set(window.levels) == {1.0 / full, 1.0}
    assert window.levels_per_count == 1.0 / full


@pytest.mark.parametrize("centre_px", [(4.0, 170.0), (474.0, 181.0), (240.0, 2.0), (239.0, 357.0)])
def test_windows_are_cut_at_the_frame_s_border(
    camera: Camera, place_plate: PlacePlate, centre_px: tuple[float, float]
) -> None:
    window = cut_plate(numbered_frame(camera), camera, place_plate(centre_px, 30.0))
    assert window.x0 >= 0
    assert window.y0 >= 0
    assert window.x0 + window.width <= camera.width
    assert window.y0 + window.height <= camera.height
    assert min(window.width, window.height) < 45
    assert max(window.width, window.height) > 68


@pytest.mark.parametrize(
    "centre_px", [(-12.0, -10.0), (-60.0, 180.0), (240.0, 700.0), (495.0, 370.0)]
)
def test_a_target_mostly_outside_the_frame_is_rejected(
    camera: Camera, place_plate: PlacePlate, centre_px: tuple[float, float]
) -> None:
    with pytest.raises(Rejection) as caught:
        cut_plate(numbered_frame(camera), camera, place_plate(centre_px, 30.0))
    assert caught.value.reason is Reason.CUT


def test_the_semi_major_axis_is_that_of_the_image(camera: Camera, place_plate: PlacePlate) -> None:
    for tilt_deg in (0.0, 50.0):
        pose = place_plate((236.3, 184.2), 30.0, tilt_deg=tilt_deg, way_deg=200.0)
        assert semi_major_axis_px(contour_px(camera, pose, RADIUS_M)) == pytest.approx(
            30.0, rel=0.01
        )
