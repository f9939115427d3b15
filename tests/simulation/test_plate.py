from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlateImage, image_plate, plate_window

CAMERA = Camera(
    width=900, height=700, fx=1210.0, fy=1206.0, cx=441.2, cy=361.7, k1=-0.09, k2=0.06
)  # fmt: skip
POSE = Pose(
    Rotation.from_euler("zyx", [131.0, 9.0, -14.0], degrees=True).as_matrix(),
    np.array([2.1, -1.4, 12.0]),
)
OPTICS = Optics(0.6)


def before(image: PlateImage, background: float) -> FloatArray:
    """Irradiance of the window before a background of irradiance."""
    return np.asarray(image.irradiance + (1.0 - image.opacity) * background)


def grey_of(image: PlateImage, gain: float = 1.0, background: float = 0.2) -> FloatArray:
    """Grey values of a linear sensor without noise, not rounded."""
    return np.asarray(255.0 * np.minimum(gain * before(image, background), 1.0))


def grey_at(image: np.ndarray, x_px: float, y_px: float, column: int, row: int) -> float:
    return float(image[round(y_px) - row, round(x_px) - column])


def test_dots_ring_and_plate_are_where_the_layout_says() -> None:
    image = image_plate(CAMERA, TARGET_PLATE, POSE, OPTICS)
    ring = TARGET_PLATE.target.ring
    dots = ring.dot_centres_m()
    turned = dots @ Rotation.from_euler("z", 120.0, degrees=True).as_matrix()[:2, :2].T
    white, black = 255.0 * TARGET_PLATE.white, 255.0 * TARGET_PLATE.black
    for points, level in ((dots, white), (turned, black)):
        for x, y in CAMERA.project(POSE.transform(points)):
            grey = grey_at(grey_of(image), x, y, image.window.column, image.window.row)
            assert abs(grey - level) < 2.0


def test_frames_scatter_about_the_plate_s_image_as_declared() -> None:
    sensor, gain = Sensor(), 0.9
    image = image_plate(CAMERA, TARGET_PLATE, POSE, OPTICS)
    electrons = sensor.full_well_e * gain * before(image, 0.3) + sensor.read_noise_e**2
    deviation = np.sqrt((255.0 / sensor.full_well_e) ** 2 * electrons + 1.0 / 12.0)
    rng = np.random.default_rng(2)
    errors = [
        (sensor.expose(before(image, 0.3), gain, rng) - grey_of(image, gain, 0.3)) / deviation
        for _ in range(10)
    ]
    assert abs(np.mean(errors)) < 0.02
    assert 0.97 < np.mean(np.square(errors)) < 1.03


def test_the_image_is_smooth_in_the_pose() -> None:
    window = plate_window(CAMERA, TARGET_PLATE, POSE, OPTICS)

    def grey(step_m: float) -> FloatArray:
        moved = Pose(POSE.rotation, POSE.translation_m + np.array([0.0, 0.0, step_m]))
        return grey_of(image_plate(CAMERA, TARGET_PLATE, moved, OPTICS, window))

    fine = (grey(1e-3) - grey(-1e-3)) / 2e-3
    coarse = (grey(1e-2) - grey(-1e-2)) / 2e-2
    assert np.linalg.norm(fine - coarse) < 0.03 * np.linalg.norm(coarse)


def test_pasting_clips_at_the_frame() -> None:
    image = image_plate(
        CAMERA, TARGET_PLATE, Pose(POSE.rotation, np.array([-4.3, -1.4, 12.0])), OPTICS
    )
    assert image.window.column < 0
    frame = np.full((700, 900), 0.3)
    image.paste(frame)
    whole = before(image, 0.3)
    row = image.window.row
    assert_allclose(
        frame[row : row + image.window.height, : image.window.width + image.window.column],
        whole[:, -image.window.column :],
    )
    assert_allclose(frame[:, 400:], 0.3)


def test_of_plates_larger_than_the_frame_only_what_it_shows_is_rendered() -> None:
    small = replace(CAMERA, width=160, height=120, cx=85.2, cy=51.7)
    pose = Pose(POSE.rotation, np.array([-0.3, 0.2, 6.0]))
    whole = plate_window(small, TARGET_PLATE, pose, OPTICS)
    part = whole.near(small, OPTICS.reach_px)
    assert whole.exceeds(small)
    assert part.width * part.height < 0.6 * whole.width * whole.height
    frames = [np.full((120, 160), 0.3), np.full((120, 160), 0.3)]
    for window, frame in zip((whole, part), frames, strict=True):
        image_plate(small, TARGET_PLATE, pose, OPTICS, window).paste(frame)
    assert np.ptp(frames[0]) > 0.7
    assert_allclose(frames[1], frames[0], atol=3e-3)  # their sub-pixels differ


def test_opaque_plates_hide_the_background() -> None:
    image: PlateImage = image_plate(CAMERA, TARGET_PLATE, POSE, OPTICS)
    assert_allclose(image.opacity.max(), 1.0, atol=1e-9)
    assert_allclose(image.opacity[0, :], 0.0, atol=1e-6)
    centre = image.opacity.shape[0] // 2, image.opacity.shape[1] // 2
    assert_allclose(before(image, 0.1)[centre], before(image, 0.9)[centre], atol=1e-9)
