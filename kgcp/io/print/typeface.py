"""The typeface of sheets and figures: DejaVu Sans, which comes with matplotlib."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import matplotlib as mpl
from matplotlib.font_manager import FontProperties
from matplotlib.ft2font import FT2Font
from matplotlib.textpath import text_to_path

from kgcp.targets.shapes import Text

CAP_HEIGHT = 0.73
"""Height of capitals relative to the type size."""
_REPLACEMENT = "?"


def font(*, is_bold: bool) -> FontProperties:
    """Return the font by its TrueType file, so that no other font can take its place."""
    return FontProperties(fname=str(_font_file(is_bold=is_bold)))


def printable(text: str, *, is_bold: bool = False) -> str:
    """Return a text with question marks for characters that the typeface lacks."""
    characters = _characters(is_bold=is_bold)
    return "".join(letter if ord(letter) in characters else _REPLACEMENT for letter in text)


@cache
def fit_text(text: Text) -> tuple[str, float]:
    """Return the printable form of a text, and the type size [mm] at which it fits."""
    words = printable(text.words, is_bold=text.is_bold)
    typeface = font(is_bold=text.is_bold)
    typeface.set_size(text.size_mm)
    width_mm, _, _ = text_to_path.get_text_width_height_descent(words, typeface, ismath=False)
    return words, text.size_mm / max(1.0, width_mm / text.room_mm)


@cache
def _characters(*, is_bold: bool) -> frozenset[int]:
    return frozenset(FT2Font(str(_font_file(is_bold=is_bold))).get_charmap())


def _font_file(*, is_bold: bool) -> Path:
    name = "DejaVuSans-Bold.ttf" if is_bold else "DejaVuSans.ttf"
    return Path(mpl.get_data_path()) / "fonts" / "ttf" / name
