"""The content of a frame: clutter on the ground, the vehicle under its plate, the plates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.ground import Ground
from kgcp.simulation.imaging import Optics
from kgcp.simulation.light_field import PlateLight
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.plate import PlainPlate, PrintedPlate, image_plate, plate_window
from kgcp.simulation.regions import Annulus, ConvexPolygon, DiscRegion, Region, polygon, rectangle

_CLUTTER_PIECES = 70
# On the roof, in plate axes: x to the vehicle's right, y to its rear.
_BODY = rectangle((0.0, 0.95), 1.9, 4.9)
_WINDSCREEN = rectangle((0.0, -1.05), 1.5, 0.5)
_REAR_WINDOW = rectangle((0.0, 2.6), 1.4, 0.35)
_BODY_BELOW_PLATE_M = 0.12
_SHADOW_SHIFT_M = (0.9, -0.7)


@dataclass(frozen=True, slots=True)
class PlatePose:
    """A plate in front of the camera; `pose` is plate → camera, `field` the light on it."""

    plate: PrintedPlate
    pose: Pose
    field: PlateLight | None = None


@dataclass(frozen=True, slots=True)
class PlainPose:
    """A plain target in front of the camera; `pose` is target → camera."""

    plate: PlainPlate
    pose: Pose
    field: PlateLight | None = None


@dataclass(frozen=True, slots=True)
class SimulatedScene:
    """Everything that one frame may see."""

    ground: Pose  # ground plane (x east, y south, z down) → camera
    carrier: PlatePose | None  # a plate on its vehicle; None: there is no vehicle
    others: tuple[PlatePose, ...]  # plates without a vehicle
    plain: tuple[PlainPose, ...] = ()  # discs and rings on the ground


def render_irradiance(
    camera: Camera, ground: Ground, scene: SimulatedScene, optics: Optics, rng: np.random.Generator
) -> FloatArray:
    """Return the irradiance (height, width) of a frame: ground, clutter, vehicle and plates.

    Everything but the plates is painted at one ray per pixel (with exact coverage at edges) and
    then spread; the plates are painted on fine sub-pixels and lie over it.
    """
    patch = PlaneRaster.of(camera, scene.ground, PixelWindow(0, 0, camera.width, camera.height))
    light = ground.radiance(patch)
    _scatter_clutter(patch, light, rng)
    if scene.carrier is not None:
        _park_vehicle(patch, light, scene.ground, scene.carrier.pose)
    irradiance = optics.spread(light, 1)
    carried = () if scene.carrier is None else (scene.carrier,)
    for placed in (*scene.plain, *scene.others, *carried):
        window = plate_window(camera, placed.plate, placed.pose, optics)
        if window.meets(camera):
            if window.exceeds(camera):
                window = window.near(camera, optics.reach_px)
            image = image_plate(camera, placed.plate, placed.pose, optics, window, placed.field)
            image.paste(irradiance)
    return irradiance


def _scatter_clutter(patch: PlaneRaster, light: FloatArray, rng: np.random.Generator) -> None:
    """Paint circles, rings, manholes, blocks and lines of all sizes over the ground, in place."""
    rows, columns = light.shape
    view_m = math.hypot(
        patch.x_m[rows // 2, -1] - patch.x_m[rows // 2, 0],
        patch.y_m[rows // 2, -1] - patch.y_m[rows // 2, 0],
    )
    for _ in range(_CLUTTER_PIECES):
        row, column = rng.integers(rows), rng.integers(columns)
        centre = (float(patch.x_m[row, column]), float(patch.y_m[row, column]))
        size_m = view_m * float(np.exp(rng.uniform(math.log(0.004), math.log(0.07))))
        opacity = float(rng.uniform(0.5, 1.0))
        for shape, value in _piece(rng, centre, size_m):
            patch.paint(light, shape, value, opacity)


def _piece(
    rng: np.random.Generator, centre: tuple[float, float], size_m: float
) -> list[tuple[Region, float]]:
    """Return the shapes of one piece of clutter, with their radiances, in painting order."""
    dark, bright = float(rng.uniform(0.02, 0.15)), float(rng.uniform(0.3, 0.9))
    value = dark if rng.random() < 0.5 else bright
    direction = float(rng.uniform(0.0, 180.0))
    inner = float(rng.uniform(0.35, 0.75))
    kind = rng.integers(5)
    if kind == 0:
        return [(DiscRegion(centre, 0.5 * size_m), value)]
    if kind == 1:
        return [(Annulus(centre, 0.5 * size_m, 0.12 * size_m), value)]
    if kind == 2:  # a manhole or a wheel: concentric like the target, without a code
        return [
            (DiscRegion(centre, 0.5 * size_m), dark),
            (DiscRegion(centre, 0.5 * inner * size_m), bright),
            (DiscRegion(centre, 0.15 * inner * size_m), dark),
        ]
    if kind == 3:
        return [(rectangle(centre, size_m, inner * size_m, direction), value)]
    return [(rectangle(centre, 8.0 * size_m, 0.08 * size_m, direction), value)]


def _park_vehicle(patch: PlaneRaster, light: FloatArray, ground: Pose, pose: Pose) -> None:
    """Paint the vehicle's shadow, body and windscreen under its plate, in place."""
    roof = Pose(pose.rotation, pose.translation_m + _BODY_BELOW_PLATE_M * pose.normal)
    corners = roof.transform(np.array(_BODY.vertices_m)) - ground.translation_m
    footprint = (corners @ ground.rotation)[:, :2]
    patch.paint(light, polygon(list(footprint + _SHADOW_SHIFT_M)), 0.04, 0.7)
    for shape, radiance in ((_BODY, 0.35), (_WINDSCREEN, 0.06), (_REAR_WINDOW, 0.07)):
        _paint_plane(patch, light, roof, shape, radiance)


def _paint_plane(
    frame: PlaneRaster, light: FloatArray, pose: Pose, shape: ConvexPolygon, value: float
) -> None:
    """Paint a shape of another plane into a frame's light, in place."""
    corner, size = outline_box(frame.camera, pose, shape)
    first = np.maximum(np.floor(corner).astype(int) - 2, 0)
    last = np.minimum(np.ceil(corner + size).astype(int) + 3, light.shape[::-1])
    if np.any(last - first < 2):
        return
    width, height = (int(extent) for extent in last - first)
    window = PixelWindow(int(first[0]), int(first[1]), width, height)
    piece = light[window.row : window.row + height, window.column : window.column + width]
    PlaneRaster.of(frame.camera, pose, window).paint(piece, shape, value)
