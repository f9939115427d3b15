"""A field of targets on paper."""

from __future__ import annotations

from kgcp.targets.fields.layout import Field, FieldPolarity
from kgcp.targets.rulers import across, ruler_mm
from kgcp.targets.shapes import Artwork, Box, Circle, Layer, Shape, Text, filled_rectangle

_MM = 1e3
_MARGIN = 0.6  # of the pitch, around the outermost discs' edges
_LETTER_MM = 4.0
_LEGEND_MM = 16.0


def draw_field(field: Field) -> Artwork:
    """Return a field with a legend and a ruler below it, about its middle.

    Bright discs are white paper in an inked board; holes show the board.
    """
    points = _MM * field.points_m()[:, :2]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radii, holes = _MM * field.radii_m(), _MM * field.inner_radii_m()
    reach = float(radii.max()) + _MARGIN * _MM * field.pitch_m
    (left, top), (right, bottom) = (points.min(axis=0) - middle), (points.max(axis=0) - middle)
    board = Box(float(left), float(top), float(right), float(bottom)).grown(reach)
    disc, ground = Layer.INK, Layer.WHITE
    shapes: list[Shape] = []
    if field.polarity is FieldPolarity.BRIGHT:
        disc, ground = Layer.WHITE, Layer.INK
        shapes.append(filled_rectangle(Layer.INK, board))
    for (x, y), radius, hole in zip((points - middle).tolist(), radii, holes, strict=True):
        shapes.append(Circle(disc, (x, y), float(radius), is_filled=True))
        if hole > 0.0:
            shapes.append(Circle(ground, (x, y), float(hole), is_filled=True))
    length_mm = ruler_mm(lambda length: length <= board.width)
    words = (
        f"{field.name}: {field.kind.value}, {field.columns} x {field.rows}, pitch"
        f" {_MM * field.pitch_m:g} mm, diameter {_MM * field.diameter_m:g} mm; print at 100 %,"
        f" measure {length_mm:g} mm:"
    )
    start = (board.left, board.bottom + 1.5 * _LETTER_MM)
    shapes.append(Text(words, start, _LETTER_MM, board.width))
    shapes += across((board.left, board.bottom + 2.8 * _LETTER_MM), length_mm, 1.0)
    whole = Box(board.left, board.top, board.right, board.bottom + _LEGEND_MM)
    return Artwork(tuple(shapes), whole)
