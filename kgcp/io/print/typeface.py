"""The typeface of printed sheets: DejaVu Sans, which comes with matplotlib."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.font_manager import FontProperties
from matplotlib.ft2font import FT2Font
from matplotlib.path import Path as Outline
from matplotlib.textpath import text_to_path

from kgcp.geometry.arrays import FloatArray
from kgcp.targets.shapes import Text

CAP_HEIGHT = 0.73
"""Height of capitals, of the type's size."""
_UNKNOWN = "?"


@dataclass(frozen=True, slots=True, eq=False)
class SetText:
    """A text as it is printed.

    Attributes
    ----------
    words : str
        Characters that the typeface lacks are question marks.
    size_mm : float
        Small enough for the text's room.
    points_mm : (n, 2) array
        Of the outlines, on the paper.
    codes : (n,) array
        What each point is, as in `matplotlib.path.Path`.
    """

    words: str
    size_mm: float
    points_mm: FloatArray
    codes: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]


def font_file(*, is_bold: bool) -> Path:
    """Return the TrueType file."""
    name = "DejaVuSans-Bold.ttf" if is_bold else "DejaVuSans.ttf"
    return Path(mpl.get_data_path()) / "fonts" / "ttf" / name


def set_text(text: Text) -> SetText:
    """Find the outlines of a text, and the size at which it fits into its room."""
    known = _characters(is_bold=text.is_bold)
    words = "".join(letter if ord(letter) in known else _UNKNOWN for letter in text.words)
    font = FontProperties(fname=str(font_file(is_bold=text.is_bold)))
    vertices, codes = text_to_path.get_text_path(font, words)
    points = np.reshape(np.asarray(vertices, dtype=float), (-1, 2)) / text_to_path.FONT_SCALE
    # What closes a contour is no point of it.
    shown = np.asarray(codes) != Outline.CLOSEPOLY
    width = float(points[shown, 0].max()) if shown.any() else 0.0
    size_mm = min(text.size_mm, text.room_mm / width) if width > 0.0 else text.size_mm
    x, y = text.start_mm
    placed = np.column_stack((x + size_mm * points[:, 0], y - size_mm * points[:, 1]))
    return SetText(words, size_mm, placed, np.asarray(codes, dtype=np.uint8))


@cache
def _characters(*, is_bold: bool) -> frozenset[int]:
    return frozenset(FT2Font(str(font_file(is_bold=is_bold))).get_charmap())
