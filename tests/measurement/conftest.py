"""Small synthetic frames for the measuring chain: rings drawn by rays on sub-pixels."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.noise import find_censoring
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.image_model.window import contour_px, cut_window, semi_major_axis_px
from kgcp.measurement.records import InitialPose
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.light_field import PlateLight
from kgcp.simulation.plate import PrintedPlate, image_plate
from kgcp.targets.layout import Ring, Target

SUBPIXELS = 4
DrawFrame = Callable[..., GreyArray]
PlacePlate = Callable[..., Pose]


@pytest.fixture(autouse=True, scope="module")
def _quickly_rendered(fewest_sub_pixels: None) -> None:
    """Render all plates and discs by few sub-pixels."""


@pytest.fixture(scope="session")
def camera() -> Camera:
    return Camera(480, 360, 900.0, 904.0, 236.3, 184.2, k1=-0.06, k2=0.05, p1=-3e-4, p2=5e-4)


@pytest.fixture(scope="session")
def target() -> Target:
    ring = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
    return Target(ring, (ring.scaled("A-inner", 0.2, (10.0, 80.0, 150.0, 250.0, 290.0)),))


@pytest.fixture(scope="session")
def place_plate(camera: Camera) -> PlacePlate:
    """Pose of a plate of 0.45 m radius seen at a pixel, with a radius and angles."""

    def place(
        centre_px: tuple[float, float],
        radius_px: float,
        *,
        tilt_deg: float = 0.0,
        way_deg: float = 0.0,
        turn_deg: float = 0.0,
    ) -> Pose:
        ray = np.append(camera.undistort(np.array(centre_px)), 1.0)
        way = np.radians(way_deg)
        tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([np.cos(way), np.sin(way), 0]))
        rotation = (tilt * Rotation.from_euler("z", turn_deg, degrees=True)).as_matrix()
        return Pose(rotation, ray * 0.45 * camera.mean_focal_px / radius_px)

    return place


@pytest.fixture(scope="session")
def draw_frame(camera: Camera) -> DrawFrame:
    """Frame of plates, each a target and its pose, on a plain ground."""

    def draw(
        *plates: tuple[Target, Pose],
        black: float = 0.08,
        white: float = 0.75,
        ground: float = 0.3,
        blur_px: float = 0.7,
        noise: float = 0.01,
        seed: int = 1,
        dtype: type = np.uint8,
    ) -> GreyArray:
        light = np.full((camera.height, camera.width), ground)
        for target, pose in plates:
            _draw_plate(light, camera, target, pose, black, white)
        light = cv2.GaussianBlur(light, (0, 0), blur_px).astype(np.float64)
        light += np.random.default_rng(seed).normal(0.0, noise, light.shape)
        full = np.iinfo(dtype).max
        return np.asarray(np.clip(np.rint(light * full), 0, full).astype(dtype))

    return draw


def _draw_plate(
    light: FloatArray, camera: Camera, target: Target, pose: Pose, black: float, white: float
) -> None:
    half_side = 0.65 * target.ring.outer_diameter_m
    corners = half_side * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    outline = camera.project(pose.transform(corners))
    x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
    x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, light.shape[::-1])
    pixels = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1)
    # Between pixel centres the rays run straight enough; the border's half pixel is ground.
    fine_size = ((x1 - x0) * SUBPIXELS, (y1 - y0) * SUBPIXELS)
    plate = cv2.resize(_on_plate(camera, pose, pixels), fine_size, interpolation=cv2.INTER_LINEAR)
    ground = np.kron(light[y0:y1, x0:x1], np.ones((SUBPIXELS, SUBPIXELS)))
    x, y = plate[..., 0], plate[..., 1]
    fine = np.where((np.abs(x) < half_side) & (np.abs(y) < half_side), white, ground)
    square = x**2 + y**2
    for ring in target.rings:
        inked = square < (0.5 * ring.outer_diameter_m) ** 2
        inked &= square > (0.5 * ring.inner_diameter_m) ** 2
        for u, v in ring.dot_centres_m():
            inked &= (x - u) ** 2 + (y - v) ** 2 > (0.5 * ring.dot_diameter_m) ** 2
        fine[inked] = black
    shape = (y1 - y0, SUBPIXELS, x1 - x0, SUBPIXELS)
    light[y0:y1, x0:x1] = fine.reshape(shape).mean(axis=(1, 3))


def _on_plate(camera: Camera, pose: Pose, pixels: FloatArray) -> FloatArray:
    """Where the rays of pixels (…, 2) meet the plate [m]."""
    normalised = camera.undistort(pixels)
    rays = np.concatenate((normalised, np.ones((*normalised.shape[:-1], 1))), axis=-1)
    depth = (pose.normal @ pose.translation_m) / (rays @ pose.normal)
    return np.asarray((rays * depth[..., None] - pose.translation_m) @ pose.rotation[:, :2])


@pytest.fixture(scope="session")
def imaging_of() -> Callable[..., FitProblem]:
    """The start of the adjustment of a drawn or photographed target."""

    def collect(grey: GreyArray, camera: Camera, target: Target, pose: Pose) -> FitProblem:
        radius_m = 0.5 * target.ring.outer_diameter_m
        window = cut_window(grey, camera, contour_px(camera, pose, radius_m), 12.0)
        circles = circles_of(target.rings)
        return FitProblem(
            window=window,
            ring=target.ring,
            circles=circles,
            measured_count=len(circles.radii_m),
            outer_radius_m=radius_m,
            outer_radius_px=semi_major_axis_px(contour_px(camera, pose, radius_m)),
            centre_px=camera.project(pose.translation_m),
            focal_px=camera.mean_focal_px,
            censoring=find_censoring(window.levels, window.levels_per_count, window.width),
            tone=Tone.of(camera.response),
            sharpening_px=0.0 if camera.response is Response.LINEAR else 1.2,
        )

    return collect


@functools.lru_cache(maxsize=64)
def _light_of(scene: bytes) -> FloatArray:
    """The light in a frame of one plate: tests expose the same scene with several sensors."""
    camera, plate, pose, optics, field = pickle.loads(scene)  # noqa: S301 - made here
    irradiance = np.full((camera.height, camera.width), 0.2)
    image_plate(camera, plate, pose, optics, field=field).paste(irradiance)
    irradiance.setflags(write=False)
    return irradiance


@pytest.fixture(scope="session")
def photograph() -> Callable[..., GreyArray]:
    """Frame of one plate by the simulator; `shade` takes light away, by pixel coordinates.

    `field` is the light on the plate, in its axes.
    """

    def take(
        camera: Camera,
        pose: Pose,
        rng: np.random.Generator,
        *,
        plate: PrintedPlate = TARGET_PLATE,
        sensor: Sensor = Sensor(),  # noqa: B008 - frozen
        gain: float = 0.9,
        shade: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
        field: PlateLight | None = None,
        optics: Optics = Optics(0.7),  # noqa: B008 - frozen
    ) -> GreyArray:
        unknown = replace(camera, response=Response.UNKNOWN)  # light does not depend on it
        irradiance = _light_of(pickle.dumps((unknown, plate, pose, optics, field))).copy()
        if shade is not None:
            y, x = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
            irradiance *= shade(x, y)
        return sensor.expose(irradiance, gain, rng)

    return take


@pytest.fixture(scope="session")
def start_near() -> Callable[..., InitialPose]:
    """A start with the errors of the search: a per cent, some tenths of a pixel, three degrees."""

    def observe(camera: Camera, pose: Pose, rng: np.random.Generator) -> InitialPose:
        error = rng.normal(0.0, (0.3, 0.3, 0.01, 0.05, 0.05, 0.01))
        translation_m = pose.translation_m * (1.0 + error[2])
        translation_m[:2] += error[:2] * pose.distance_m / camera.mean_focal_px
        near = Pose(pose.rotation, translation_m).moved(np.array([0.0, 0.0, 0.0, *error[3:]]))
        radius_px = semi_major_axis_px(contour_px(camera, near, 0.45))
        return InitialPose("A", 0.97, near, radius_px, edge_shift_px=0.0, blur_px=0.0)

    return observe
