"""One simulated frame for the search: planned from a seed, rendered, with its truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.simulation.ground import Ground
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.plate import PlateImage, PrintedPlate
from kgcp.simulation.regions import ConvexPolygon, DiscRegion
from kgcp.simulation.scene import PlatePose, SimulatedScene, render_irradiance

_ROAD_RADIUS_M = 180.0
_AROUND_M = (100.0, 260.0)  # range of the distances of plates from the centre of the road's bend
_ROOF_M, _STAND_M = 1.95, 0.05  # height of plates with and without a vehicle
_NEAREST_VEHICLE_M = 6.0  # nearer vehicles exceed the view and reach behind the camera
_OVERSAMPLING = 4
_ATTEMPTS = 60
_SEPARATION = 1.6  # least distance of two plates, relative to the sum of their radii


@dataclass(frozen=True, slots=True)
class ImagingChain:
    """A kind of camera: how it converts light to the grey values of a file."""

    name: str
    sensor: Sensor
    response: Response
    jpeg_quality: int | None


_FILM = Sensor(tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1)
IMAGING_CHAINS = (
    ImagingChain("linear", Sensor(), Response.LINEAR, None),
    ImagingChain("srgb", Sensor(tone=ToneCurve.SRGB), Response.SRGB, 95),
    ImagingChain("consumer", _FILM, Response.UNKNOWN, 92),
)
CAMERAS = (
    Camera(800, 600, 1182.0, 1179.0, 391.6, 307.4, -0.072, 0.055, 0.0004, -0.0003),
    Camera(640, 900, 1384.0, 1390.0, 327.3, 441.9, -0.11, 0.08, -0.0006, 0.0005),
    Camera(1000, 640, 1351.0, 1351.0, 507.8, 312.2, 0.03, 0.01, 0.0002, 0.0008),
)


@dataclass(frozen=True, slots=True)
class Obstacle:
    """An object on a plate, or its shadow.

    Attributes
    ----------
    shape : DiscRegion or ConvexPolygon
        Outline on the plate [m].
    pose : Pose
        Pose of the plate.
    radiance : float or None
        None: textured like the ground.
    """

    shape: DiscRegion | ConvexPolygon
    pose: Pose
    radiance: float | None
    opacity: float = 1.0


@dataclass(frozen=True, slots=True)
class Veil:
    """Haze: share of the scene's light that remains, and light scattered into the view."""

    share: float = 1.0
    light: float = 0.0


@dataclass(frozen=True, slots=True)
class Shot:
    """Everything that determines a frame, except its noise.

    Attributes
    ----------
    wanted : tuple of PlatePose
        Plates that should be found.
    decoys : tuple of (kind, PlatePose)
        Plates that should not be found.
    gain : float
        Exposure, relative to that at which a radiance of 1 fills the full well.
    """

    camera: Camera
    chain: ImagingChain
    scene: SimulatedScene
    wanted: tuple[PlatePose, ...]
    decoys: tuple[tuple[str, PlatePose], ...]
    obstacles: tuple[Obstacle, ...]
    optics: Optics
    gain: float
    veil: Veil


def stream(seed: int, name: str, index: int, purpose: str) -> np.random.Generator:
    """Return a generator of random numbers for one purpose in one frame of a set."""
    key = (*name.encode(), index, *purpose.encode())
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


def radius_px(camera: Camera, seen: PlatePose) -> float:
    """Return the radius of the main ring in the image as if it were seen from the front [px]."""
    ring = seen.plate.target.ring
    return 0.5 * ring.outer_diameter_m * camera.mean_focal_px / seen.pose.distance_m


def tilt_deg(pose: Pose) -> float:
    """Return the angle between a plate's normal and the viewing ray of its centre [deg]."""
    return math.degrees(math.acos(float(pose.normal @ pose.translation_m) / pose.distance_m))


def random_camera(rng: np.random.Generator) -> tuple[Camera, ImagingChain]:
    """Return a random camera of a random kind."""
    chain = IMAGING_CHAINS[rng.integers(len(IMAGING_CHAINS))]
    return replace(CAMERAS[rng.integers(len(CAMERAS))], response=chain.response), chain


def halved(camera: Camera) -> Camera:
    """Return a camera with half the pixels per side, which saves time with very large plates."""
    width, height = camera.width // 2, camera.height // 2
    fx, fy, cx, cy = (0.5 * value for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def place(
    camera: Camera,
    plate: PrintedPlate,
    pixel: FloatArray,
    ring_px: float,
    tilt: tuple[float, float],
    rng: np.random.Generator,
) -> PlatePose:
    """Put a plate in front of the camera, with a random tilt against the viewing ray [deg]."""
    ray = np.append(camera.undistort(pixel), 1.0)
    ray /= np.linalg.norm(ray)
    axis = np.cross((0.0, 0.0, 1.0), ray)
    angle = math.asin(min(1.0, float(np.linalg.norm(axis))))
    aligned = Rotation.from_rotvec(axis / max(float(np.linalg.norm(axis)), 1e-12) * angle)
    way = rng.uniform(0.0, 2.0 * math.pi)
    tilted = Rotation.from_rotvec(
        math.radians(rng.uniform(*tilt)) * np.array([math.cos(way), math.sin(way), 0.0])
    )
    turned = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)
    distance_m = 0.5 * plate.target.ring.outer_diameter_m * camera.mean_focal_px / ring_px
    return PlatePose(plate, Pose((aligned * tilted * turned).as_matrix(), distance_m * ray))


def pixel_inside(camera: Camera, ring_px: float, rng: np.random.Generator) -> FloatArray:
    """Return a pixel at which a ring of this radius is completely in the frame, if possible."""
    size = np.array([camera.width, camera.height], dtype=np.float64)
    margin = np.minimum(1.2 * ring_px + 4.0, 0.5 * size)
    pixel: FloatArray = margin + rng.random(2) * (size - 2.0 * margin) - 0.5
    return pixel


def place_apart(
    camera: Camera,
    plates: Sequence[PrintedPlate],
    ring_px: tuple[float, float],
    tilt: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[PlatePose | None, ...]:
    """Put plates where they do not hide each other; None for plates without enough room."""
    taken: list[tuple[FloatArray, float]] = []
    placed: list[PlatePose | None] = []
    for plate in plates:
        place_found = None
        for _ in range(_ATTEMPTS):
            radius = float(np.exp(rng.uniform(*np.log(ring_px))))
            pixel = pixel_inside(camera, radius, rng)
            if all(
                np.linalg.norm(pixel - other) > _SEPARATION * (radius + size)
                for other, size in taken
            ):
                taken.append((pixel, radius))
                place_found = place(camera, plate, pixel, radius, tilt, rng)
                break
        placed.append(place_found)
    return tuple(placed)


def scene_around(
    main: PlatePose, others: Sequence[PlatePose], rng: np.random.Generator
) -> SimulatedScene:
    """Return a scene with ground below a plate, and in half of the cases a vehicle between them."""
    driven = main.pose.distance_m > _NEAREST_VEHICLE_M and bool(rng.random() < 0.5)
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True).as_matrix()
    rotation = main.pose.rotation @ turn
    way, radius_m = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(*_AROUND_M)
    below = np.array(
        [radius_m * math.cos(way), radius_m * math.sin(way), -(_ROOF_M if driven else _STAND_M)]
    )
    ground = Pose(rotation, main.pose.translation_m - rotation @ below)
    return (
        SimulatedScene(ground, main, tuple(others))
        if driven
        else SimulatedScene(ground, None, (*others, main))
    )


@lru_cache(maxsize=2)
def _ground(seed: int) -> Ground:
    return Ground.grown(stream(seed, "ground", 0, "texture"), _ROAD_RADIUS_M)


def render(shot: Shot, seed: int, rng: np.random.Generator) -> GreyArray:
    """Return the frame (height, width) of grey values, as it would be read from its file."""
    ground = _ground(seed)
    irradiance = render_irradiance(shot.camera, ground, shot.scene, shot.optics, rng)
    for obstacle in shot.obstacles:
        _cover(irradiance, shot, obstacle, ground)
    irradiance *= shot.veil.share
    irradiance += shot.veil.light
    grey = shot.chain.sensor.expose(irradiance, shot.gain, rng)
    if shot.chain.jpeg_quality is None:
        return grey
    _, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, shot.chain.jpeg_quality])
    decoded: GreyArray = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return decoded


def _cover(irradiance: FloatArray, shot: Shot, obstacle: Obstacle, ground: Ground) -> None:
    """Draw an obstacle over the rendered irradiance, in place."""
    corner, size = outline_box(shot.camera, obstacle.pose, obstacle.shape)
    margin = shot.optics.reach_px
    column, row = np.floor(corner).astype(int) - margin
    width, height = np.ceil(size).astype(int) + 2 * margin + 1
    window = PixelWindow(int(column), int(row), int(width), int(height))
    if not window.meets(shot.camera):
        return
    window = window.near(shot.camera, margin)
    patch = PlaneRaster.of(shot.camera, obstacle.pose, window, _OVERSAMPLING)
    opacity = np.zeros_like(patch.x_m)
    patch.paint(opacity, obstacle.shape, obstacle.opacity)
    if obstacle.radiance is None:
        light = opacity * ground.radiance(patch)
    else:
        light = opacity * obstacle.radiance
    spread = shot.optics.spread
    PlateImage(window, spread(opacity, _OVERSAMPLING), spread(light, _OVERSAMPLING)).paste(
        irradiance
    )
