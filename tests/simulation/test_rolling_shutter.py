from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.flight import TARGET_PLATE, plan_flight
from kgcp.simulation.imaging import Optics
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster
from kgcp.simulation.plate import image_plate
from kgcp.simulation.presets import preset
from kgcp.simulation.regions import DiscRegion, Region, rectangle
from kgcp.simulation.rolling_shutter import ImageMotion, RowMotion

CAMERA = Camera(width=640, height=480, fx=1000.0, fy=1000.0, cx=320.3, cy=240.7)
WINDOW = PixelWindow(280, 200, 80, 90)
FACING = Pose(np.eye(3), np.array([0.0, 0.0, 1000.0]))  # one metre is one pixel


def scene(shape: Region, oversampling: int) -> FloatArray:
    patch = PlaneRaster.of(CAMERA, FACING, WINDOW, oversampling)
    image = np.zeros_like(patch.x_m)
    patch.paint(image, shape, 1.0)
    return image


@pytest.mark.parametrize("oversampling", [1, 4, 5])
def test_without_motion_it_is_a_global_shutter(oversampling: int) -> None:
    image = scene(DiscRegion((1.7, -4.2), 13.0), oversampling)
    still = RowMotion((0.0, 0.0), 100.0, 480)
    rolled = Optics(0.7, (0.4, 1.0), motion=still).spread(image, oversampling, WINDOW.row)
    assert_allclose(rolled, Optics(0.7, (0.4, 1.0)).spread(image, oversampling), atol=1e-12)


def test_rows_are_displaced_by_rate_times_time() -> None:
    readout_s, rate_px_s = 0.024, (180.0, -90.0)
    motion = ImageMotion(rate_px_s, 0.0).drawn(
        replace(CAMERA, readout_s=readout_s), 237.4, np.random.default_rng(0)
    )
    image = scene(rectangle((1.3, 3.0), 17.0, 60.0), 4)  # vertical edges, 60 rows high
    rolled = Optics(0.7, motion=motion).spread(image, 4, WINDOW.row)
    rows = WINDOW.row + np.arange(WINDOW.height)
    columns = WINDOW.column + np.arange(WINDOW.width)
    inner = (rows > 225) & (rows < 262)
    centroid = (rolled @ columns / rolled.sum(axis=1))[inner]
    time_s = (rows[inner] - 237.4) / 479.0 * readout_s
    assert_allclose(centroid, 320.3 + 1.3 + 180.0 * time_s, atol=1e-7)
    assert_allclose(rolled.sum(axis=1)[inner], 17.0, atol=1e-7)


def test_edges_along_the_rows_are_displaced_by_their_row_s_delay() -> None:
    motion = RowMotion((0.0, 0.01), 240.0, 480)
    image = scene(rectangle((0.0, 5.0), 200.0, 40.0), 4)  # y from −15 to 25 about the centre
    rolled = Optics(0.7, motion=motion).spread(image, 4, WINDOW.row)[:, 40]
    # The edge at y₀ is met in the row y with y = y₀ + 0.01 (y − 240).
    top, bottom = ((240.7 + y - 2.4) / 0.99 for y in (-15.0, 25.0))
    assert rolled.sum() == pytest.approx(bottom - top, abs=1e-3)  # sums over rows: aliased a little
    rows = WINDOW.row + np.arange(WINDOW.height)
    assert rolled @ rows / rolled.sum() == pytest.approx(0.5 * (top + bottom), abs=1e-3)


def test_the_row_of_the_centre_shows_the_pose() -> None:
    pose = Pose(
        Rotation.from_euler("zyx", [131.0, 9.0, -14.0], degrees=True).as_matrix(),
        np.array([0.4, -0.3, 9.0]),
    )
    _, row = CAMERA.project(pose.translation_m[None])[0]
    motion = RowMotion((0.02, 0.0), round(row), 480)
    still = image_plate(CAMERA, TARGET_PLATE, pose, Optics(0.7))
    moved = image_plate(CAMERA, TARGET_PLATE, pose, Optics(0.7, motion=motion))
    at = round(row) - still.window.row
    shift = still.window.column - moved.window.column
    wanted = still.irradiance[at]
    found = moved.irradiance[round(row) - moved.window.row, shift : shift + len(wanted)]
    assert_allclose(found, wanted, atol=2e-3)  # their sub-pixels differ


def test_frame_times_are_those_of_the_middle_row() -> None:
    settings = replace(preset("rolling").without_survey_errors(), frames=30)
    plan = plan_flight(settings, 2)
    global_plan = plan_flight(replace(settings, camera=replace(settings.camera, readout_s=0.0)), 2)
    assert_allclose(plan.target_map, global_plan.target_map)
    for frame, recorded_s in zip(plan.frames, plan.recorded_times_s, strict=True):
        _, row = settings.camera.project(frame.target.translation_m[None])[0]
        motion = frame.optics.motion
        assert motion is not None
        assert_allclose(motion.px_per_row, (160.0 * 0.03 / 1199.0, 200.0 * 0.03 / 1199.0))
        if frame.present:
            since_middle_s = (row / 1199.0 - 0.5) * 0.03
            assert frame.time_s - recorded_s == pytest.approx(since_middle_s, abs=1e-6)
            assert motion.still_row == pytest.approx(row)


def test_random_motion_scatters_as_declared() -> None:
    camera = replace(CAMERA, readout_s=0.479)
    rng = np.random.default_rng(3)
    drawn = [ImageMotion((50.0, 0.0), 20.0).drawn(camera, 0.0, rng) for _ in range(2000)]
    rates = np.array([motion.px_per_row for motion in drawn])
    assert_allclose(rates.mean(axis=0), (0.05, 0.0), atol=0.002)
    assert_allclose(rates.std(axis=0), 0.02, rtol=0.06)
