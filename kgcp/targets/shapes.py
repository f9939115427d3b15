"""Shapes on paper, in millimetres: x to the right, y down."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

Point = tuple[float, float]
LINE_MM = 0.2
"""Width of lines, which only help to cut, drill and measure."""


class Layer(StrEnum):
    """Purpose of a shape; in DXF the name of its layer."""

    INK = "INK"
    WHITE = "WHITE"
    PLATE = "PLATE"
    HOLES = "HOLES"
    CROP = "CROP"
    RULER = "RULER"
    TEXT = "TEXT"

    @property
    def grey(self) -> float:
        """Printed brightness, 0…1."""
        if self is Layer.WHITE:
            return 1.0
        return 0.45 if self in {Layer.PLATE, Layer.HOLES, Layer.CROP} else 0.0


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle: its line, or its area if it is filled."""

    layer: Layer
    centre_mm: Point
    radius_mm: float
    is_filled: bool = False


@dataclass(frozen=True, slots=True)
class Polyline:
    """A line through points, or the area that it surrounds if it is filled."""

    layer: Layer
    points_mm: tuple[Point, ...]
    is_filled: bool = False


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text, made smaller where it would be wider than its room."""

    words: str
    start_mm: Point  # left end of the baseline
    size_mm: float  # of the type: from line to line, set solid
    room_mm: float  # how wide it may be
    is_bold: bool = False


Shape = Circle | Polyline | Text


@dataclass(frozen=True, slots=True)
class Box:
    """An upright rectangle [mm]."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def width(self) -> float:
        """Extent from left to right [mm]."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Extent from top to bottom [mm]."""
        return self.bottom - self.top

    @property
    def corners(self) -> tuple[Point, Point, Point, Point]:
        """All four, clockwise from the top left."""
        return (
            (self.left, self.top),
            (self.right, self.top),
            (self.right, self.bottom),
            (self.left, self.bottom),
        )

    def grown(self, margin: float) -> Box:
        """Return the box with a margin all around."""
        return Box(self.left - margin, self.top - margin, self.right + margin, self.bottom + margin)

    def moved(self, x: float, y: float) -> Box:
        """Return the box elsewhere."""
        return Box(self.left + x, self.top + y, self.right + x, self.bottom + y)

    def distance_to(self, x: float, y: float) -> float:
        """Return the distance of a point, 0 within [mm]."""
        dx = max(self.left - x, 0.0, x - self.right)
        dy = max(self.top - y, 0.0, y - self.bottom)
        return float((dx * dx + dy * dy) ** 0.5)


def filled_rectangle(layer: Layer, box: Box) -> Polyline:
    """Return a filled box."""
    return Polyline(layer, box.corners, is_filled=True)


@dataclass(frozen=True, slots=True)
class Artwork:
    """All there is to print of one target, about its centre."""

    shapes: tuple[Shape, ...]  # in painting order
    box: Box  # what has to be on the paper


@dataclass(frozen=True, slots=True)
class Sheet:
    """One sheet of paper; its own axes begin at its top left corner."""

    label: str  # of one sheet among several: `r1c2`, row and column; else empty
    width_mm: float
    height_mm: float
    artwork: Artwork
    centre_mm: Point  # where the artwork's origin is on the sheet
    window: Box  # the part of the sheet that shows the artwork
    marks: tuple[Shape, ...] = ()  # of the sheet itself
