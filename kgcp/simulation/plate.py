"""Rendering of plates: exact coverage of sub-pixels, blurred and integrated over pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.imaging import Optics
from kgcp.simulation.light_field import PlateLight
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.regions import ConvexPolygon, DiscRegion, Region
from kgcp.targets.layout import Target
from kgcp.targets.plain import PlainPolarity, PlainTarget

# Sub-pixels along the longer side of a window. This limits memory and time, and gives small targets
# the most sub-pixels per pixel.
_SUB_PIXELS_ACROSS = 1000


@dataclass(frozen=True, slots=True)
class PrintedPlate:
    """A target as it was printed."""

    target: Target
    outline: ConvexPolygon  # of the white plate [m]
    # radiance of plate and ink under the frame's light, 0…1
    white: float = 0.88
    black: float = 0.05

    def print_layers(self) -> Iterator[tuple[Region, float]]:
        """Yield what is printed on the plate, shapes and radiances, in painting order."""
        for ring in self.target.rings:
            yield DiscRegion((0.0, 0.0), 0.5 * ring.outer_diameter_m), self.black
            yield DiscRegion((0.0, 0.0), 0.5 * ring.inner_diameter_m), self.white
            for x, y in ring.dot_centres_m():
                yield DiscRegion((float(x), float(y)), 0.5 * ring.dot_diameter_m), self.white


@dataclass(frozen=True, slots=True)
class PlainPlate:
    """A plain target with its border, each of uniform radiance."""

    target: PlainTarget  # without a `border_m`, it lies on the ground as it is
    # radiances under the frame's light, 0…1
    bright: float = 0.85
    dark: float = 0.06

    @property
    def border_m(self) -> float:
        """Width of the even ground around the target [m]; 0: none."""
        return self.target.border_m or 0.0

    @property
    def outline(self) -> DiscRegion:
        """The area that hides the ground."""
        return DiscRegion((0.0, 0.0), self.target.radii_m[0] + self.border_m)

    @property
    def white(self) -> float:
        """Radiance of the border, or of the target itself where it has none."""
        return self._radiance(1) if self.border_m else self._radiance(0)

    def print_layers(self) -> Iterator[tuple[Region, float]]:
        """Yield what is on the plate, shapes and radiances, in painting order."""
        for circle, radius_m in enumerate(self.target.radii_m):
            if circle == 0 and not self.border_m:
                continue  # it is the plate
            yield DiscRegion((0.0, 0.0), radius_m), self._radiance(circle)

    def _radiance(self, circle: int) -> float:
        """Return the radiance within a circle, counted from the outside."""
        is_bright = (self.target.polarity is PlainPolarity.BRIGHT) == (circle % 2 == 0)
        return self.bright if is_bright else self.dark


Plate = PrintedPlate | PlainPlate


@dataclass(frozen=True, slots=True, eq=False)
class PlateImage:
    """Light of a plate in the pixels of a window."""

    window: PixelWindow
    opacity: FloatArray  # (height, width): share of the background that the plate hides, 0…1
    irradiance: FloatArray  # (height, width): light that comes from the plate

    def paste(self, frame: FloatArray) -> None:
        """Put the plate into a frame's irradiance, in place; the window must meet the frame."""
        height, width = frame.shape
        window = self.window
        top, left = max(window.row, 0), max(window.column, 0)
        bottom = min(window.row + window.height, height)
        right = min(window.column + window.width, width)
        inside = (
            slice(top - window.row, bottom - window.row),
            slice(left - window.column, right - window.column),
        )
        piece = frame[top:bottom, left:right]
        piece *= 1.0 - self.opacity[inside]
        piece += self.irradiance[inside]


def plate_window(camera: Camera, plate: Plate, pose: Pose, optics: Optics) -> PixelWindow:
    """Return the window with all pixels that light from the plate reaches."""
    corner, size = outline_box(camera, pose, plate.outline)
    margin = optics.reach_px
    column, row = np.floor(corner).astype(int) - margin
    last_column, last_row = np.ceil(corner + size).astype(int) + margin
    return PixelWindow(
        int(column), int(row), int(last_column - column) + 1, int(last_row - row) + 1
    )


def image_plate(
    camera: Camera,
    plate: Plate,
    pose: Pose,
    optics: Optics,
    window: PixelWindow | None = None,
    field: PlateLight | None = None,
) -> PlateImage:
    """Ray-cast a plate through the full distorted camera.

    Parameters
    ----------
    pose : Pose
        Target → camera.
    window : PixelWindow, optional
        Pixels to render; default: all that light from the plate reaches.
    field : PlateLight, optional
        Light on the plate; default: uniform.
    """
    if window is None:
        window = plate_window(camera, plate, pose, optics)
    longest = max(window.width, window.height)
    oversampling = int(np.clip(_SUB_PIXELS_ACROSS // longest, 4, 8))
    patch = PlaneRaster.of(camera, pose, window, oversampling)
    opacity = np.zeros_like(patch.x_m)
    patch.paint(opacity, plate.outline, 1.0)
    light = plate.white * opacity
    for shape, radiance in plate.print_layers():
        patch.paint(light, shape, radiance)
    if field is not None:
        light = field.shine_on(patch, light, opacity)
    return PlateImage(
        window,
        optics.spread(opacity, oversampling, window.row),
        optics.spread(light, oversampling, window.row),
    )
