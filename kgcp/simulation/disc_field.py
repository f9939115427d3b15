"""Photographs of fields of plain discs and rings: exact coverage through the full camera.

Every circle is painted on its own plane by exact coverage of sub-pixels, multiplied by the light,
and blurred over pixels. The light of all circles is added up, so that circles may touch. No code is
shared with the model that measures them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D
from kgcp.geometry.pose import Pose
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.regions import AnnularSector, ConvexPolygon, DiscRegion, Region

_SUB_PIXELS_ACROSS = 1200  # sub-pixels along the longer side of a window
_MIN_SUB_PIXELS, _MAX_SUB_PIXELS = 4, 10  # limits per pixel and axis


@dataclass(frozen=True, slots=True)
class SimulatedDisc:
    """A disc, or a ring, in the frame of its field."""

    position_m: tuple[float, float, float]  # of its centre [m]
    diameter_m: float
    inner_diameter_m: float = 0.0  # diameter of its hole; 0: no hole
    # unit normal; by default the field's z axis, which points into the board
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    code: DiscCode | None = None  # sectors of ink around it


@dataclass(frozen=True, slots=True)
class DiscCode:
    """A ring of equal sectors around a disc, from its plane's x axis towards its y axis."""

    inner_diameter_m: float
    outer_diameter_m: float
    sectors: tuple[bool, ...]  # whether each is inked

    def regions(self) -> Iterator[AnnularSector]:
        """Yield the sectors of ink."""
        step = 2.0 * math.pi / len(self.sectors)
        for number, is_inked in enumerate(self.sectors):
            if is_inked:
                inner_m, outer_m = 0.5 * self.inner_diameter_m, 0.5 * self.outer_diameter_m
                yield AnnularSector(inner_m, outer_m, number * step, (number + 1) * step)


@dataclass(frozen=True, slots=True)
class FieldScene:
    """A field under its light."""

    discs: tuple[SimulatedDisc, ...]
    # radiance of the board and of the discs on it at the frame's middle, 0…1; discs may be brighter
    # than the board
    ground: float = 0.8
    ink: float = 0.06
    gradient: tuple[float, float] = (0.0, 0.0)  # change of light along x and y, relative [1/px]
    # edges of the board in the field's plane z = 0: x and y of one corner and of the opposite one
    # [m]; None: the board is infinite
    board_m: tuple[float, float, float, float] | None = None
    surround: float = 0.3  # radiance beyond the board

    def light(self, camera: Camera, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Return the light at columns x (m,) and rows y (n,), relative to the frame's middle."""
        along_x, along_y = self.gradient
        off_x, off_y = x_px - 0.5 * (camera.width - 1), y_px - 0.5 * (camera.height - 1)
        return np.asarray(1.0 + along_x * off_x[None, :] + along_y * off_y[:, None])


def photograph(
    camera: Camera,
    pose: Pose,
    scene: FieldScene,
    optics: Optics,
    sensor: Sensor,
    rng: np.random.Generator,
    gain: float = 1.0,
) -> GreyArray:
    """Return a photograph (uint8) of a field.

    Parameters
    ----------
    pose : Pose
        Field → camera.
    gain : float
        Exposure relative to the one at which radiance 1 fills the well.
    """
    return sensor.expose(field_irradiance(camera, pose, scene, optics), gain, rng)


def field_irradiance(camera: Camera, pose: Pose, scene: FieldScene, optics: Optics) -> FloatArray:
    """Return the irradiance (height, width) of all pixels by a field, without noise.

    Discs that are not wholly in front of the camera are left out.
    """
    columns, rows = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
    frame = _board(camera, pose, scene, optics)
    if frame is None:
        frame = scene.ground * scene.light(camera, columns, rows)
    for disc in scene.discs:
        plane = disc_pose(pose, disc)
        if plane.translation_m[2] <= 0.5 * disc.diameter_m:
            continue
        shapes: list[Region] = [DiscRegion((0.0, 0.0), 0.5 * disc.diameter_m)]
        if disc.inner_diameter_m > 0.0:
            shapes.append(DiscRegion((0.0, 0.0), 0.5 * disc.inner_diameter_m))
        _add(frame, camera, plane, shapes, scene.ink - scene.ground, scene, optics)
        for sector in disc.code.regions() if disc.code is not None else ():
            _add(frame, camera, plane, [sector], scene.ink - scene.ground, scene, optics)
    return frame


def disc_pose(pose: Pose, disc: SimulatedDisc) -> Pose:
    """Return the pose of a disc's plane (disc → camera) from that of its field."""
    circle = field_circles(pose, [disc])
    axes = circle.axes[0]
    rotation = np.column_stack((axes, np.cross(axes[:, 0], axes[:, 1])))
    return Pose(rotation, circle.centres_m[0])


def field_circles(pose: Pose, discs: Sequence[SimulatedDisc]) -> Circles3D:
    """Return the outer circles of discs in the camera frame, from the field's pose."""
    positions = np.array([disc.position_m for disc in discs], dtype=np.float64)
    normals = np.array([disc.normal for disc in discs], dtype=np.float64)
    radii_m = np.array([0.5 * disc.diameter_m for disc in discs])
    return Circles3D.with_normals(pose.transform(positions), normals @ pose.rotation.T, radii_m)


def _board(camera: Camera, pose: Pose, scene: FieldScene, optics: Optics) -> FloatArray | None:
    """Return the frame with the bare board; None if the board is infinite."""
    if scene.board_m is None:
        return None
    left, top, right, bottom = scene.board_m
    outline = ConvexPolygon(((left, top), (right, top), (right, bottom), (left, bottom)))
    columns, rows = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
    frame = scene.surround * scene.light(camera, columns, rows)
    _add(frame, camera, pose, [outline], scene.ground - scene.surround, scene, optics)
    return frame


def _add(
    frame: FloatArray,
    camera: Camera,
    plane: Pose,
    shapes: Sequence[Region],
    radiance: float,
    scene: FieldScene,
    optics: Optics,
) -> None:
    """Add the light of the first shape without the others to a frame, in place."""
    window = _window(camera, plane, shapes[0], optics)
    if window.width <= 0 or window.height <= 0:
        return
    longest = max(window.width, window.height)
    oversampling = int(np.clip(_SUB_PIXELS_ACROSS // longest, _MIN_SUB_PIXELS, _MAX_SUB_PIXELS))
    raster = PlaneRaster.of(camera, plane, window, oversampling)
    covered = np.zeros_like(raster.x_m)
    for number, shape in enumerate(shapes):
        raster.paint(covered, shape, 1.0 if number == 0 else 0.0)
    step = 1.0 / oversampling
    x_px = np.asarray(window.column - 0.5 + step * (np.arange(covered.shape[1]) + 0.5))
    y_px = np.asarray(window.row - 0.5 + step * (np.arange(covered.shape[0]) + 0.5))
    covered *= radiance * scene.light(camera, x_px, y_px)
    part = optics.spread(covered, oversampling, window.row)
    top, left = max(window.row, 0), max(window.column, 0)
    bottom = min(window.row + window.height, camera.height)
    right = min(window.column + window.width, camera.width)
    if top < bottom and left < right:
        inside = part[top - window.row : bottom - window.row, left - window.column :]
        frame[top:bottom, left:right] += inside[:, : right - left]


def _window(camera: Camera, plane: Pose, shape: Region, optics: Optics) -> PixelWindow:
    """Return the window with all pixels in or near the frame that light from a shape reaches."""
    corner, size = outline_box(camera, plane, shape)
    margin = optics.reach_px + 1
    column, row = np.floor(corner).astype(int) - margin
    last_column, last_row = np.ceil(corner + size).astype(int) + margin
    window = PixelWindow(
        int(column), int(row), int(last_column - column) + 1, int(last_row - row) + 1
    )
    return window.near(camera, margin)
