"""A field of targets on paper."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.targets.fields.layout import Field, FieldPolarity
from kgcp.targets.fields.points import AnyField, PointField
from kgcp.targets.rulers import across, ruler_mm
from kgcp.targets.shapes import (
    Artwork,
    Box,
    Circle,
    Layer,
    Polyline,
    Primitive,
    Text,
    filled_rectangle,
)

_MM = 1e3
_MARGIN = 0.6  # around the outermost discs' edges, relative to the pitch
_POINT_MARGIN = 0.5  # around the outermost discs or codes, relative to the largest diameter
_LETTER_MM = 4.0
_LEGEND_MM = 16.0
_FLATNESS_M = 1e-6  # largest distance from the plane of a sheet
_ARC_STEPS = 120  # chords per full circle, for sectors


def draw_field(field: AnyField) -> Artwork:
    """Return a field with a legend and a ruler below it, about its middle.

    Bright discs are white paper in an inked board; holes show the board. For fields of points, x
    points to the right, y down and z into the paper, which decides the side that is printed.

    Raises
    ------
    SettingError
        If the points do not lie in a plane, or their diameters are not known.
    """
    if isinstance(field, PointField):
        _require_sheet(field)
    points = _MM * field.points_m()[:, :2]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radii, holes = _MM * field.radii_m(), _MM * field.inner_radii_m()
    (left, top), (right, bottom) = (points.min(axis=0) - middle), (points.max(axis=0) - middle)
    board = Box(float(left), float(top), float(right), float(bottom)).grown(_reach_mm(field))
    disc, ground = Layer.INK, Layer.WHITE
    shapes: list[Primitive] = []
    if field.polarity is FieldPolarity.BRIGHT:
        disc, ground = Layer.WHITE, Layer.INK
        shapes.append(filled_rectangle(Layer.INK, board))
    for (x, y), radius, hole in zip((points - middle).tolist(), radii, holes, strict=True):
        shapes.append(Circle(disc, (x, y), float(radius), is_filled=True))
        if hole > 0.0:
            shapes.append(Circle(ground, (x, y), float(hole), is_filled=True))
    if isinstance(field, PointField):
        shapes += _codes(field, disc, points - middle)
    length_mm = ruler_mm(lambda length: length <= board.width)
    words = f"{_described(field)}; print at 100 %, measure {length_mm:g} mm:"
    start = (board.left, board.bottom + 1.5 * _LETTER_MM)
    shapes.append(Text(words, start, _LETTER_MM, board.width))
    shapes += across((board.left, board.bottom + 2.8 * _LETTER_MM), length_mm, 1.0)
    whole = Box(board.left, board.top, board.right, board.bottom + _LEGEND_MM)
    return Artwork(tuple(shapes), whole)


def _require_sheet(field: PointField) -> None:
    is_flat = np.ptp(field.points_m()[:, 2]) <= _FLATNESS_M
    if not is_flat or np.abs(field.normals()[:, :2]).max() > _FLATNESS_M:
        raise SettingError(
            "points",
            "do not lie in one plane of equal z, as on a sheet",
            "print their parts separately",
        )
    if not field.is_diameter_stated:
        raise SettingError("diameter_m", "is missing", "state how large the discs are")


def _reach_mm(field: AnyField) -> float:
    """Return how far the board reaches beyond the middles of the outermost discs."""
    largest = _MM * float(field.radii_m().max())
    if isinstance(field, Field):
        return largest + _MARGIN * _MM * field.pitch_m
    return largest * ((1.0 if field.code is None else field.code.outer) + 2.0 * _POINT_MARGIN)


def _described(field: AnyField) -> str:
    if isinstance(field, Field):
        return (
            f"{field.name}: {field.kind.value}, {field.columns} x {field.rows}, pitch"
            f" {_MM * field.pitch_m:g} mm, diameter {_MM * field.diameter_m:g} mm"
        )
    coded = "" if field.code is None else f", codes of {field.code.bits} bits"
    return f"{field.name}: {len(field.points)} discs{coded}"


def _codes(field: PointField, layer: Layer, centres_mm: FloatArray) -> Iterator[Primitive]:
    """Yield the sectors of all codes that have the discs' brightness, neighbours as one."""
    for point, centre_mm in zip(field.points, centres_mm, strict=True):
        if field.code is None or point.code is None:
            continue
        for first, last in _runs(point.code, field.code.bits):
            steps = max(math.ceil(_ARC_STEPS * (last - first) / field.code.bits), 2)
            turns = 2.0 * np.pi / field.code.bits * np.linspace(first, last, steps + 1)
            around = np.stack((np.cos(turns), np.sin(turns)), axis=1)
            edge = np.concatenate((field.code.outer * around, field.code.inner * around[::-1]))
            corners_mm = centre_mm + 0.5 * _MM * point.diameter_m * edge
            yield Polyline(layer, tuple((x, y) for x, y in corners_mm.tolist()), is_filled=True)


def _runs(code: int, bits: int) -> list[tuple[int, int]]:
    """Return where runs of ones begin and end, going round from the highest bit."""
    ones = [bool(code >> (bits - 1 - number) & 1) for number in range(bits)]
    begins = [number for number in range(bits) if ones[number] and not ones[number - 1]]
    return [
        (begin, begin + next(k for k in range(bits) if not ones[(begin + k) % bits]))
        for begin in begins
    ]
