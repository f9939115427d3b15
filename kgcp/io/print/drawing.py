"""Sheets as PDF, SVG and PNG: one matplotlib figure in true millimetres, the same bytes each time.

Matplotlib draws its figures in inches. A sheet is a figure of exactly its size without
axes. A transform places its shapes, which are in millimetres on paper, y down.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D, Transform, TransformedBbox
from matplotlib.transforms import Bbox as Extent
from PIL import Image

from kgcp.errors import SettingError
from kgcp.io.print.typeface import fit_text, font
from kgcp.targets.shapes import LINE_MM, Circle, Primitive, Sheet, Text

_MM_PER_INCH = 25.4
_PT_PER_MM = 72.0 / _MM_PER_INCH
_MAX_PIXELS = 400e6
# Circles are cubic curves of 1/16 of a circle each, off by less than 1e-8 of the radius. In
# pictures, matplotlib would paint chords instead, off by 0.04 px.
_UNIT_CIRCLE = Outline.arc(0.0, 360.0, n=16)
_STYLE = {
    "pdf.fonttype": 42,  # text stays text, which can be searched …
    "svg.fonttype": "path",  # … but becomes outlines in SVG, which need no typeface
    "svg.hashsalt": "kgcp",  # the same figure has the same identifiers
    "path.snap": False,  # edges are not moved to whole pixels
    "path.simplify": False,
}


def pdf_of(sheets: Sequence[Sheet], title: str) -> bytes:
    """Return the sheets as a PDF file, one page each."""
    stream = io.BytesIO()
    metadata = {"Title": title, "Creator": "kgcp", "Producer": None, "CreationDate": None}
    with style.context(["default", _STYLE]), PdfPages(stream, metadata=metadata) as pages:
        for sheet in sheets:
            pages.savefig(_figure(sheet))
    return stream.getvalue()


def svg_of(sheet: Sheet) -> bytes:
    """Return a sheet as an SVG file."""
    stream = io.BytesIO()
    with style.context(["default", _STYLE]):
        _figure(sheet).savefig(stream, format="svg", metadata={"Date": None, "Creator": "kgcp"})
    return stream.getvalue()


def png_of(sheet: Sheet, dpi: int) -> bytes:
    """Return a sheet as a grey picture that carries its resolution."""
    stream = io.BytesIO()
    with style.context(["default", _STYLE]):
        canvas = FigureCanvasAgg(_figure(sheet, dpi))
        canvas.draw()
    grey = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 0])
    Image.fromarray(grey).save(stream, format="PNG", dpi=(dpi, dpi))
    return stream.getvalue()


def check_pixels(width_mm: float, height_mm: float, dpi: int) -> None:
    """Refuse pictures of more pixels than most programs open.

    Raises
    ------
    SettingError
    """
    pixels = width_mm * height_mm * (dpi / _MM_PER_INCH) ** 2
    if pixels > _MAX_PIXELS:
        max_dpi = int(dpi * (_MAX_PIXELS / pixels) ** 0.5)
        raise SettingError(
            "dpi",
            f"{dpi} gives {pixels / 1e6:.0f} million pixels on {width_mm:.0f} × {height_mm:.0f} mm",
            f"give at most {max_dpi}, or choose PDF, SVG or DXF",
        )


def _figure(sheet: Sheet, dpi: int | None = None) -> Figure:
    """Draw a sheet; with a resolution, on paper of whole pixels.

    Rounding changes the margins at the right and at the bottom, never the scale.
    """
    size_in = np.array([sheet.width_mm, sheet.height_mm]) / _MM_PER_INCH
    if dpi is not None:
        size_in = (np.rint(size_in * dpi) + 1e-6) / dpi  # matplotlib rounds down
    figure = Figure(figsize=(size_in[0], size_in[1]), dpi=dpi or 72)
    inches = Affine2D().scale(1.0 / _MM_PER_INCH, -1.0 / _MM_PER_INCH).translate(0.0, size_in[1])
    paper = inches + figure.dpi_scale_trans
    artwork = Affine2D().translate(*sheet.centre_mm) + paper
    box = sheet.window
    window = TransformedBbox(Extent([(box.left, box.top), (box.right, box.bottom)]), paper)
    for shape in sheet.artwork.shapes:
        artist = _artist(figure, shape, artwork)
        artist.set_clip_box(window)
        artist.set_clip_on(True)
    for shape in sheet.marks:
        _artist(figure, shape, paper)
    return figure


def _artist(figure: Figure, shape: Primitive, transform: Transform) -> Artist:
    """Add a shape to a figure."""
    if isinstance(shape, Text):
        words, size_mm = fit_text(shape)
        return figure.text(
            *shape.start_mm,
            words,
            transform=transform,
            fontproperties=font(is_bold=shape.is_bold),
            fontsize=_PT_PER_MM * size_mm,
            parse_math=False,
        )
    if isinstance(shape, Circle):
        place = Affine2D().scale(shape.radius_mm).translate(*shape.centre_mm)
        outline = _UNIT_CIRCLE.transformed(place)
    else:
        outline = Outline(np.array(shape.points_mm), closed=False)
    ink = str(shape.layer.grey)
    patch = PathPatch(
        outline,
        facecolor=ink if shape.is_filled else "none",
        edgecolor="none" if shape.is_filled else ink,
        linewidth=0.0 if shape.is_filled else _PT_PER_MM * LINE_MM,
        transform=transform,
    )
    return figure.add_artist(patch)
