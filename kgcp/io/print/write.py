"""Writing sheets to files of the chosen formats."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from kgcp.errors import SettingError
from kgcp.io.files.atomic import write_bytes
from kgcp.io.print.drawing import check_pixels, pdf_of, png_of, svg_of
from kgcp.io.print.dxf import dxf_of
from kgcp.targets.shapes import Sheet

FORMATS = ("pdf", "svg", "dxf", "png")
_MAX_STEM_BYTES = 100  # names have at most 255, whole paths on Windows mostly 260


def file_stem(name: str) -> str:
    """Return a file name for a target that every file system takes.

    It begins with a word, so that it is none of the names that Windows reserves for devices
    (CON, NUL, …). Long names are cut, and a digest stands for what is left out.
    """
    stem = "target_" + re.sub(r"[^\w.-]+", "_", name)
    encoded = stem.encode()
    if len(encoded) <= _MAX_STEM_BYTES:
        return stem
    digest = hashlib.sha256(encoded).hexdigest()[:8]
    return f"{encoded[:_MAX_STEM_BYTES].decode(errors='ignore')}_{digest}"


def check_stems(names: Sequence[str]) -> None:
    """Refuse targets whose files would have the same name.

    Raises
    ------
    SettingError
    """
    stems: dict[str, str] = {}
    for name in names:
        other = stems.setdefault(file_stem(name).casefold(), name)
        if other != name:
            problem = f"{other!r} and {name!r} would both have the file name {file_stem(name)!r}"
            raise SettingError("name", problem, "rename one of them")


def write_sheets(
    sheets: Sequence[Sheet], name: str, folder: Path, formats: Iterable[str], dpi: int
) -> list[Path]:
    """Write the sheets of one target, and return the files.

    Raises
    ------
    KgcpError
        If a picture would be too large, or a file cannot be written.
    """
    formats = tuple(dict.fromkeys(formats))
    if "png" in formats:
        check_pixels(sheets[0].width_mm, sheets[0].height_mm, dpi)
    files = []
    for form in formats:
        for label, content in _contents(sheets, f"Target {name}", form, dpi):
            suffix = f"_{label}" if label else ""
            path = folder / f"{file_stem(name)}{suffix}.{form}"
            write_bytes(path, content)
            files.append(path)
    return files


def _contents(
    sheets: Sequence[Sheet], title: str, form: str, dpi: int
) -> Iterator[tuple[str, bytes]]:
    """Yield the files of a format with the labels of their sheets; a file of all has none."""
    if form == "pdf":
        yield "", pdf_of(sheets, title)
    elif form == "dxf":
        yield "", dxf_of(sheets[0].artwork)
    elif form == "svg":
        yield from ((sheet.label, svg_of(sheet)) for sheet in sheets)
    else:
        yield from ((sheet.label, png_of(sheet, dpi)) for sheet in sheets)
