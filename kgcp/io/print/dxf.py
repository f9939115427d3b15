"""Artwork as DXF in millimetres for plotters and engravers: contours on layers, never tiled."""

from __future__ import annotations

import io

import ezdxf
from ezdxf import units
from ezdxf.layouts import Modelspace

from kgcp.io.print.typeface import CAP_HEIGHT, fit_text
from kgcp.targets.shapes import Artwork, Circle, Layer, Primitive, Text

_STYLE = "SANS"
_COLOURS = {Layer.PLATE: 3, Layer.HOLES: 5, Layer.CROP: 8, Layer.WHITE: 1}  # AutoCAD's indices


def dxf_of(artwork: Artwork) -> bytes:
    """Return the artwork as a DXF file, its origin at the circles' centre, y up."""
    was_fixed = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True  # neither dates nor random identifiers
    try:
        drawing = ezdxf.new("R2010", units=units.MM)
        drawing.styles.add(_STYLE, font="DejaVuSans.ttf")
        for layer in Layer:
            drawing.layers.add(layer.value, color=_COLOURS.get(layer, 7))
        for shape in artwork.shapes:
            _add(drawing.modelspace(), shape)
        for name in sorted(drawing.entitydb.dxf_types_in_use()):
            drawing.classes.add_class(name)  # else ezdxf adds them in the order of a set
        stream = io.StringIO()
        drawing.write(stream)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = was_fixed
    return stream.getvalue().encode(drawing.output_encoding)


def _add(space: Modelspace, shape: Primitive) -> None:
    if isinstance(shape, Text):
        words, size_mm = fit_text(shape)
        place = shape.start_mm[0], -shape.start_mm[1]
        attributes = {"layer": Layer.TEXT.value, "style": _STYLE, "insert": place}
        space.add_text(words, height=CAP_HEIGHT * size_mm, dxfattribs=attributes)
        return
    on_layer = {"layer": shape.layer.value}
    if isinstance(shape, Circle):
        x, y = shape.centre_mm
        space.add_circle((x, -y), shape.radius_mm, dxfattribs=on_layer)
    else:
        points = [(x, -y) for x, y in shape.points_mm]
        space.add_lwpolyline(points, close=shape.is_filled, dxfattribs=on_layer)
