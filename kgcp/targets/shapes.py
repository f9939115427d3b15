"""Shapes on paper, in millimetres: x to the right, y down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

Point = tuple[float, float]
LINE_MM = 0.2
"""Width of lines for cutting, drilling and measuring."""
_MAX_LETTER_WIDTH = 0.75  # average over a line of text, relative to the type's size


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
    """A circle: its outline, or its area if it is filled."""

    layer: Layer
    centre_mm: Point
    radius_mm: float
    is_filled: bool = False


@dataclass(frozen=True, slots=True)
class Polyline:
    """A line through points, or the enclosed area if it is filled."""

    layer: Layer
    points_mm: tuple[Point, ...]
    is_filled: bool = False


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text; its type is made smaller if it would be wider than its room."""

    words: str
    start_mm: Point  # left end of the baseline
    size_mm: float  # of the type: distance of lines set solid
    room_mm: float  # largest width
    is_bold: bool = False


Primitive = Circle | Polyline | Text


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
        """Return the box shifted by x and y."""
        return Box(self.left + x, self.top + y, self.right + x, self.bottom + y)

    def overlaps(self, other: Box) -> bool:
        """Whether the two have a part in common."""
        is_beside = self.right <= other.left or other.right <= self.left
        return not (is_beside or self.bottom <= other.top or other.bottom <= self.top)

    def distance_to(self, x: float, y: float) -> float:
        """Return the distance of a point from the box, 0 inside [mm]."""
        dx = max(self.left - x, 0.0, x - self.right)
        dy = max(self.top - y, 0.0, y - self.bottom)
        return float((dx * dx + dy * dy) ** 0.5)


def _is_seen(shape: Primitive, box: Box) -> bool:
    """Tell whether a box shows part of a shape, ignoring other shapes on top of it."""
    if isinstance(shape, Circle):
        nearest = box.distance_to(*shape.centre_mm)
        farthest = max(math.dist(shape.centre_mm, corner) for corner in box.corners)
        return nearest < shape.radius_mm and (shape.is_filled or farthest > shape.radius_mm)
    if isinstance(shape, Text):
        (x, y), size = shape.start_mm, shape.size_mm
        width = min(shape.room_mm, _MAX_LETTER_WIDTH * size * len(shape.words))
        return Box(x, y - size, x + width, y + size).overlaps(box)
    pairs = (shape.points_mm,) if shape.is_filled else pairwise(shape.points_mm)
    return any(_around(points).grown(LINE_MM).overlaps(box) for points in pairs)


def _around(points: Sequence[Point]) -> Box:
    columns, rows = zip(*points, strict=True)
    return Box(min(columns), min(rows), max(columns), max(rows))


def filled_rectangle(layer: Layer, box: Box) -> Polyline:
    """Return a filled box."""
    return Polyline(layer, box.corners, is_filled=True)


@dataclass(frozen=True, slots=True)
class Artwork:
    """The complete print of one target; the origin is its centre."""

    shapes: tuple[Primitive, ...]  # in painting order
    box: Box  # area that has to be on the paper
    white_mm: float = 0.0  # radius about the origin within which the paper has to be white

    def shows_something(self, part: Box) -> bool:
        """Tell whether a part of the artwork has ink, or white that the target needs."""
        if part.distance_to(0.0, 0.0) < self.white_mm:
            return True
        inked = (shape for shape in self.shapes if getattr(shape, "layer", None) != Layer.WHITE)
        return any(_is_seen(shape, part) for shape in inked)


@dataclass(frozen=True, slots=True)
class Sheet:
    """One sheet of paper; its origin is the top left corner."""

    label: str  # row and column among several sheets, such as `r1c2`; empty for a single sheet
    width_mm: float
    height_mm: float
    artwork: Artwork
    centre_mm: Point  # place of the artwork's origin on the sheet
    window: Box  # the part of the sheet that shows the artwork
    marks: tuple[Primitive, ...] = ()  # marks of the sheet, outside the artwork
