"""Sheets as PDF, one page each: vectors, embedded type, and a request not to scale them."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.pdfgen.pathobject import PDFPathObject

from kgcp.io.print.typeface import font_file, set_text
from kgcp.targets.shapes import LINE_MM, Area, Circle, Disc, Point, Shape, Sheet, Text

_PT_PER_MM = 72.0 / 25.4
# PDF knows no circles. Cubic curves over 1/16 of one are off by less than 1e-8 of the radius.
_ARCS = 16


def pdf_of(sheets: Sequence[Sheet], title: str) -> bytes:
    """Return the sheets as a PDF file."""
    for name, is_bold in (("Sans", False), ("Sans-Bold", True)):
        pdfmetrics.registerFont(TTFont(name, str(font_file(is_bold=is_bold))))
    stream = io.BytesIO()
    canvas = Canvas(stream, invariant=1)  # neither date nor random identifier
    canvas.setTitle(title)
    canvas.setCreator("kgcp")
    canvas.setViewerPreference("PrintScaling", "None")
    for sheet in sheets:
        _draw(canvas, sheet)
        canvas.showPage()
    canvas.save()
    return stream.getvalue()


def _draw(canvas: Canvas, sheet: Sheet) -> None:
    """Draw a sheet in millimetres, y down."""
    canvas.setPageSize((sheet.width_mm * _PT_PER_MM, sheet.height_mm * _PT_PER_MM))
    canvas.scale(_PT_PER_MM, _PT_PER_MM)
    canvas.translate(0.0, sheet.height_mm)
    canvas.setLineWidth(LINE_MM)
    canvas.saveState()
    window = canvas.beginPath()
    canvas.clipPath(_polygon(window, _upwards(sheet.window.corners)), stroke=0, fill=0)
    canvas.translate(sheet.centre_mm[0], -sheet.centre_mm[1])
    for shape in sheet.artwork.shapes:
        _add(canvas, shape)
    canvas.restoreState()
    for shape in sheet.marks:
        _add(canvas, shape)


def _add(canvas: Canvas, shape: Shape) -> None:
    if isinstance(shape, Text):
        printed = set_text(shape)
        canvas.setFillGray(0.0)
        canvas.setFont("Sans-Bold" if shape.is_bold else "Sans", printed.size_mm)
        canvas.drawString(shape.start_mm[0], -shape.start_mm[1], printed.words)
        return
    canvas.setFillGray(shape.layer.grey)
    canvas.setStrokeGray(shape.layer.grey)
    path = canvas.beginPath()
    if isinstance(shape, Disc | Circle):
        _circle(path, shape.centre_mm, shape.radius_mm)
    elif isinstance(shape, Area):
        _polygon(path, _upwards(shape.points_mm))
    else:
        _polyline(path, _upwards(shape.points_mm))
    is_filled = isinstance(shape, Disc | Area)
    canvas.drawPath(path, stroke=int(not is_filled), fill=int(is_filled))


def _upwards(points_mm: Sequence[Point]) -> list[Point]:
    return [(x, -y) for x, y in points_mm]


def _polyline(path: PDFPathObject, points: Sequence[Point]) -> None:
    path.moveTo(*points[0])
    for point in points[1:]:
        path.lineTo(*point)


def _polygon(path: PDFPathObject, points: Sequence[Point]) -> PDFPathObject:
    _polyline(path, points)
    path.close()
    return path


def _circle(path: PDFPathObject, centre_mm: Point, radius: float) -> None:
    x, y = centre_mm[0], -centre_mm[1]
    step = 2.0 * math.pi / _ARCS
    reach = 4.0 / 3.0 * math.tan(0.25 * step)
    path.moveTo(x + radius, y)
    for arc in range(_ARCS):
        c0, s0 = math.cos(arc * step), math.sin(arc * step)
        c1, s1 = math.cos((arc + 1) * step), math.sin((arc + 1) * step)
        path.curveTo(
            x + radius * (c0 - reach * s0),
            y + radius * (s0 + reach * c0),
            x + radius * (c1 + reach * s1),
            y + radius * (s1 - reach * c1),
            x + radius * c1,
            y + radius * s1,
        )
    path.close()
