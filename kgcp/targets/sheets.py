"""Artwork on paper: on one sheet, or in tiles to be cut and laid edge to edge."""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import StrEnum

from kgcp.errors import SettingError
from kgcp.targets.artwork import crop_marks
from kgcp.targets.rulers import THICK_MM, across, down
from kgcp.targets.shapes import Artwork, Box, Primitive, Sheet, Text

_MARGIN_MM = 10.0
_TILE_MARGIN_MM = 15.0  # printers leave up to 5 mm blank; the rest is for the marks
_BLEED_MM = 3.0  # artwork beyond the cut, so that no white line remains
_MARK_GAP_MM, _MARK_MM = 5.0, 5.0
_RULER_MM = 100.0
_MAX_PAGE_MM = 5000.0  # of PDF: 14400 pt
_MAX_TILES = 400


class Paper(StrEnum):
    """A sheet of paper; `fit` is as large as the artwork needs."""

    FIT = "fit"
    A4 = "A4"
    A3 = "A3"
    A2 = "A2"
    A1 = "A1"
    A0 = "A0"

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height in portrait format, by ISO 216; not defined for `fit` [mm]."""
        return {
            Paper.A4: (210.0, 297.0),
            Paper.A3: (297.0, 420.0),
            Paper.A2: (420.0, 594.0),
            Paper.A1: (594.0, 841.0),
            Paper.A0: (841.0, 1189.0),
        }[self]


def lay_out(artwork: Artwork, name: str, paper: Paper, *, is_tiled: bool) -> tuple[Sheet, ...]:
    """Return the sheets that show the artwork at true scale.

    Parameters
    ----------
    name : str
        Name of the target, for messages and the margins of tiles.
    is_tiled : bool
        Whether several sheets may be used if one does not suffice.

    Raises
    ------
    SettingError
        If the artwork does not fit.
    """
    need_mm = artwork.box.width + 2.0 * _MARGIN_MM, artwork.box.height + 2.0 * _MARGIN_MM
    if paper is Paper.FIT:
        if is_tiled:
            raise SettingError("sheet", "'fit' is one sheet", "name the sheets of the tiles")
        if max(need_mm) > _MAX_PAGE_MM:
            raise _too_large(name, need_mm, "a PDF page has at most 5 m", "make it smaller")
        return (_one_sheet(artwork, need_mm),)
    for size_mm in (paper.size_mm, paper.size_mm[::-1]):
        if need_mm[0] <= size_mm[0] and need_mm[1] <= size_mm[1]:
            return (_one_sheet(artwork, size_mm),)
    if not is_tiled:
        remedy = "allow several sheets, or take a larger one or 'fit'"
        raise _too_large(name, need_mm, f"{paper} is smaller", remedy)
    plans = [_grid(artwork.box, size_mm) for size_mm in (paper.size_mm, paper.size_mm[::-1])]
    size_mm, rows, columns = min(plans, key=lambda plan: plan[1] * plan[2])
    if rows * columns > _MAX_TILES:
        remedy = "take larger sheets"
        raise _too_large(name, need_mm, f"it takes {rows * columns} sheets of {paper}", remedy)
    return tuple(_tiles(artwork, name, size_mm, rows, columns))


def _too_large(name: str, need_mm: tuple[float, float], why: str, remedy: str) -> SettingError:
    width, height = need_mm
    return SettingError("sheet", f"{name!r} needs {width:.0f} × {height:.0f} mm, {why}", remedy)


def _one_sheet(artwork: Artwork, size_mm: tuple[float, float]) -> Sheet:
    """Return a sheet with the artwork in its middle."""
    box, (width, height) = artwork.box, size_mm
    centre = 0.5 * (width - box.left - box.right), 0.5 * (height - box.top - box.bottom)
    return Sheet("", width, height, artwork, centre, Box(0.0, 0.0, width, height))


def _grid(box: Box, size_mm: tuple[float, float]) -> tuple[tuple[float, float], int, int]:
    """Return the sheet's size, and rows and columns of its tiles."""
    width, height = (side - 2.0 * _TILE_MARGIN_MM for side in size_mm)
    return size_mm, math.ceil(box.height / height), math.ceil(box.width / width)


def _tiles(
    artwork: Artwork, name: str, size_mm: tuple[float, float], rows: int, columns: int
) -> Iterator[Sheet]:
    """Yield the tiles that show something, row by row, each in the middle of its sheet."""
    box, (sheet_width, sheet_height) = artwork.box, size_mm
    width, height = box.width / columns, box.height / rows
    left, top = 0.5 * (sheet_width - width), 0.5 * (sheet_height - height)
    cut = Box(left, top, left + width, top + height)
    for row in range(rows):
        for column in range(columns):
            centre = left - box.left - column * width, top - box.top - row * height
            if not artwork.shows_something(cut.moved(-centre[0], -centre[1])):
                continue
            words = (
                f"{name}: row {row + 1} of {rows}, column {column + 1} of {columns}."
                " Cut along the marks, lay edge to edge; blank tiles are left out."
            )
            yield Sheet(
                f"r{row + 1}c{column + 1}",
                sheet_width,
                sheet_height,
                artwork,
                centre,
                cut.grown(_BLEED_MM),
                tuple(_tile_marks(cut, words)),
            )


def _tile_marks(cut: Box, words: str) -> Iterator[Primitive]:
    """Yield the marks around a tile: crop marks, its label, and rulers."""
    yield from crop_marks(cut, _MARK_GAP_MM, _MARK_MM)
    foot = cut.bottom + _MARK_GAP_MM + THICK_MM
    yield from across((cut.left + 4.0, foot), _RULER_MM, 1.0, is_marked=False)
    side = cut.left - _MARK_GAP_MM - THICK_MM
    yield from down((side, cut.bottom - 4.0), _RULER_MM, 1.0, is_marked=False)
    start = cut.left + _RULER_MM + 6.0
    yield Text("100 mm", (start, foot), 2.6, 12.0)
    head = cut.top - _MARK_GAP_MM - 1.0
    yield Text(words, (cut.left + 4.0, head), 2.8, cut.width - 8.0)
