"""Sheets as SVG: true circles, millimetres, text as outlines so that no typeface is needed."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np
from matplotlib.path import Path as Outline

from kgcp.io.print.typeface import set_text
from kgcp.targets.shapes import LINE_MM, Area, Circle, Disc, Layer, Point, Shape, Sheet, Text

_LETTERS = {Outline.MOVETO: "M", Outline.LINETO: "L", Outline.CURVE3: "Q", Outline.CURVE4: "C"}
_POINTS = {Outline.CURVE3: 2, Outline.CURVE4: 3}


def svg_of(sheet: Sheet) -> bytes:
    """Return a sheet as an SVG file."""
    size = _number(sheet.width_mm), _number(sheet.height_mm)
    root = ET.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        version="1.1",
        width=f"{size[0]}mm",
        height=f"{size[1]}mm",
        viewBox=f"0 0 {size[0]} {size[1]}",
    )
    ET.SubElement(root, "rect", width=size[0], height=size[1], fill="#fff")
    window = ET.SubElement(ET.SubElement(root, "clipPath", id="window"), "rect")
    for key, value in (
        ("x", sheet.window.left),
        ("y", sheet.window.top),
        ("width", sheet.window.width),
        ("height", sheet.window.height),
    ):
        window.set(key, _number(value))
    clipped = ET.SubElement(root, "g", {"clip-path": "url(#window)"})
    move = f"translate({' '.join(map(_number, sheet.centre_mm))})"
    artwork = ET.SubElement(clipped, "g", transform=move)
    for parent, shapes in ((artwork, sheet.artwork.shapes), (root, sheet.marks)):
        for shape in shapes:
            _add(parent, shape)
    ET.indent(root)
    content: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _add(parent: ET.Element, shape: Shape) -> None:
    if isinstance(shape, Text):
        letters = ET.SubElement(parent, "path", d=_outlines(shape))
        letters.set("aria-label", shape.words)
        return
    ink = _colour(shape.layer)
    if isinstance(shape, Disc | Circle):
        circle = ET.SubElement(parent, "circle")
        circle.set("cx", _number(shape.centre_mm[0]))
        circle.set("cy", _number(shape.centre_mm[1]))
        circle.set("r", _number(shape.radius_mm))
        _paint(circle, ink, is_filled=isinstance(shape, Disc))
        return
    kind = "polygon" if isinstance(shape, Area) else "polyline"
    points = " ".join(map(_pair, shape.points_mm))
    _paint(ET.SubElement(parent, kind, points=points), ink, is_filled=isinstance(shape, Area))


def _paint(element: ET.Element, ink: str, *, is_filled: bool) -> None:
    if is_filled:
        element.set("fill", ink)
    else:
        element.set("fill", "none")
        element.set("stroke", ink)
        element.set("stroke-width", _number(LINE_MM))


def _outlines(text: Text) -> str:
    """Return the path data of a text."""
    printed = set_text(text)
    parts: list[str] = []
    index = 0
    while index < len(printed.codes):
        code = printed.codes[index]
        if code == Outline.CLOSEPOLY:
            parts.append("Z")
            index += 1
            continue
        count = _POINTS.get(code, 1)
        points = printed.points_mm[index : index + count]
        parts.append(_LETTERS[code] + " ".join(_pair((x, y)) for x, y in points))
        index += count
    return "".join(parts)


def _colour(layer: Layer) -> str:
    return f"#{3 * f'{round(255 * layer.grey):02x}'}"


def _pair(point: Point) -> str:
    return f"{_number(point[0])},{_number(point[1])}"


def _number(value: float) -> str:
    """Write millimetres to a tenth of a micrometre, without needless digits."""
    return np.format_float_positional(round(value, 4) + 0.0, trim="-")
