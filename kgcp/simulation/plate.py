"""The printed plate as light: exact coverage on sub-pixels, spread and integrated over pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.light_field import LightField
from kgcp.simulation.patch import Patch, PixelWindow, outline_box
from kgcp.simulation.shapes import ConvexPolygon, Disc, Shape
from kgcp.targets.layout import Ring, Target

_SUB_PIXELS_ACROSS = 1000  # of a window: memory and time are bounded, small targets get most


@dataclass(frozen=True, slots=True)
class Plate:
    """A target as it was printed.

    Attributes
    ----------
    target : Target
    outline : ConvexPolygon
        Of the white plate [m].
    white, black : float
        Radiance of plate and ink under the frame's light, 0…1.
    """

    target: Target
    outline: ConvexPolygon
    white: float = 0.88
    black: float = 0.05

    def print_layers(self) -> Iterator[tuple[Shape, float]]:
        """Yield what is printed on the plate, shapes and radiances, in painting order."""
        for ring in self.target.rings:
            yield from self._ring_layers(ring)

    def _ring_layers(self, ring: Ring) -> Iterator[tuple[Shape, float]]:
        yield Disc((0.0, 0.0), 0.5 * ring.outer_diameter_m), self.black
        yield Disc((0.0, 0.0), 0.5 * ring.inner_diameter_m), self.white
        for x, y in ring.dot_centres_m():
            yield Disc((float(x), float(y)), 0.5 * ring.dot_diameter_m), self.white


@dataclass(frozen=True, slots=True, eq=False)
class PlateImage:
    """What a plate sends to the pixels of a window.

    Attributes
    ----------
    window : PixelWindow
    opacity : (height, width) array
        How much of what lies behind the plate is hidden, 0…1.
    irradiance : (height, width) array
        Light that comes from the plate.
    """

    window: PixelWindow
    opacity: FloatArray
    irradiance: FloatArray

    def over(self, background: FloatArray | float) -> FloatArray:
        """Return the irradiance of the window before a background of irradiance (or one value).

        Pixels on the plate's outline mix it with the background as the background's own pixels
        have it, already spread.
        """
        return self.irradiance + (1.0 - self.opacity) * background

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


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedWindow:
    """Grey values without noise, and the noise they would have.

    Attributes
    ----------
    window : PixelWindow
    grey : (height, width) array
        0…255, not rounded.
    variance : (height, width) array
        Of the grey values, rounding included.
    """

    window: PixelWindow
    grey: FloatArray
    variance: FloatArray


def plate_window(camera: Camera, plate: Plate, pose: Pose, optics: Optics) -> PixelWindow:
    """Return the window that holds everything the plate sends light to."""
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
    field: LightField | None = None,
) -> PlateImage:
    """Ray-cast a plate through the full distorted camera.

    Parameters
    ----------
    camera : Camera
    plate : Plate
    pose : Pose
        Target → camera.
    optics : Optics
    window : PixelWindow, optional
        Where to look; default: everything that the plate sends light to.
    field : LightField, optional
        Default: the same light everywhere.
    """
    if window is None:
        window = plate_window(camera, plate, pose, optics)
    longest = max(window.width, window.height)
    oversampling = int(np.clip(_SUB_PIXELS_ACROSS // longest, 4, 8))
    patch = Patch.of(camera, pose, window, oversampling)
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


def expected_window(
    camera: Camera,
    plate: Plate,
    pose: Pose,
    optics: Optics,
    sensor: Sensor,
    gain: float,
    *,
    background: float = 0.2,
    window: PixelWindow | None = None,
) -> ExpectedWindow:
    """Return what a frame shows of a plate without noise, and the variance of the noise.

    The simulator's own image model, for Cramér-Rao bounds: differentiate `grey` with respect to
    pose, radiances, point spread or gain in a fixed `window`, and weigh by `variance`. JPEG
    compression is not part of it.

    Parameters
    ----------
    camera, plate, pose, optics, sensor
        The model; `plate` carries the radiances of plate and ink.
    gain : float
        Exposure relative to the one at which radiance 1 fills the well.
    background : float
        Radiance around the plate.
    window : PixelWindow, optional
        Default: everything that the plate sends light to.
    """
    image = image_plate(camera, plate, pose, optics, window)
    irradiance = image.over(background)
    return ExpectedWindow(
        image.window, sensor.expected(irradiance, gain), sensor.variance(irradiance, gain)
    )
