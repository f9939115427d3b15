"""Rulers to check the scale of a print: bars of ten pieces, alternately black and white."""

from __future__ import annotations

from collections.abc import Callable

from kgcp.targets.shapes import Box, Layer, Point, Polyline, Primitive, Text, filled_rectangle

_LENGTHS_MM = (1000.0, 500.0, 200.0, 100.0, 50.0, 20.0, 10.0)
_PIECES = 10
THICK_MM = 2.4
_TYPE_MM = 2.8
_HALF_DIGIT = 0.32 * _TYPE_MM


def ruler_mm(fits: Callable[[float], bool]) -> float:
    """Return the longest round length that fits [mm]."""
    return next((length for length in _LENGTHS_MM if fits(length)), _LENGTHS_MM[-1])


def across(
    corner: Point, length_mm: float, unit: float, *, is_marked: bool = True
) -> list[Primitive]:
    """Return a horizontal ruler with its lower left corner at a point."""
    (x, y), step, thick = corner, length_mm / _PIECES, THICK_MM * unit
    outline = Box(x, y - thick, x + length_mm, y)
    shapes: list[Primitive] = [
        filled_rectangle(Layer.RULER, Box(x + i * step, outline.top, x + (i + 1) * step, y))
        for i in range(0, _PIECES, 2)
    ]
    shapes.append(_frame(outline))
    if is_marked:
        for share in (0.0, 0.5, 1.0):
            digits = f"{share * length_mm:g}"
            aside = _HALF_DIGIT * len(digits) * unit if share else 0.0
            below = x + share * length_mm - aside
            place = (below, y + 1.3 * _TYPE_MM * unit)
            words = digits + (" mm" if share == 1.0 else "")
            shapes.append(Text(words, place, _TYPE_MM * unit, 16.0 * unit))
    return shapes


def down(
    corner: Point, length_mm: float, unit: float, *, is_marked: bool = True
) -> list[Primitive]:
    """Return a vertical ruler with its lower left corner at a point."""
    (x, y), step, thick = corner, length_mm / _PIECES, THICK_MM * unit
    outline = Box(x, y - length_mm, x + thick, y)
    shapes: list[Primitive] = [
        filled_rectangle(Layer.RULER, Box(x, y - (i + 1) * step, outline.right, y - i * step))
        for i in range(0, _PIECES, 2)
    ]
    shapes.append(_frame(outline))
    if is_marked:
        for share in (0.5, 1.0):
            place = (x + thick + unit, y - share * length_mm + 0.75 * _TYPE_MM * unit)
            words = f"{share * length_mm:g}"
            shapes.append(Text(words, place, _TYPE_MM * unit, 9.0 * unit))
    return shapes


def _frame(box: Box) -> Polyline:
    corners = box.corners
    return Polyline(Layer.RULER, (*corners, corners[0]))
