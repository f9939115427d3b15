"""Sheets into files of the chosen formats."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from kgcp.errors import SettingError
from kgcp.io.files.atomic import write_bytes
from kgcp.targets.shapes import Sheet

FORMATS = ("pdf", "svg", "dxf", "png")


def file_stem(name: str) -> str:
    """Return a file name for a target, without what file systems do not like."""
    return "target_" + re.sub(r"[^\w.-]+", "_", name)


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
            problem = f"{other!r} and {name!r} would both be the file {file_stem(name)!r}"
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
    from kgcp.io.print.png import check_pixels

    formats = tuple(dict.fromkeys(formats))
    if "png" in formats:
        check_pixels(sheets[0].width_mm, sheets[0].height_mm, dpi)
    contents: dict[str, Callable[[], Iterator[tuple[str, bytes]]]] = {
        "pdf": lambda: _pdf(sheets, name),
        "svg": lambda: _svgs(sheets),
        "dxf": lambda: _dxf(sheets),
        "png": lambda: _pngs(sheets, name, dpi),
    }
    files = []
    for form in formats:
        for label, content in contents[form]():
            suffix = f"_{label}" if label else ""
            path = folder / f"{file_stem(name)}{suffix}.{form}"
            write_bytes(path, content)
            files.append(path)
    return files


def _pdf(sheets: Sequence[Sheet], name: str) -> Iterator[tuple[str, bytes]]:
    from kgcp.io.print.pdf import pdf_of

    yield "", pdf_of(sheets, f"Target {name}")


def _svgs(sheets: Sequence[Sheet]) -> Iterator[tuple[str, bytes]]:
    from kgcp.io.print.svg import svg_of

    yield from ((sheet.label, svg_of(sheet)) for sheet in sheets)


def _dxf(sheets: Sequence[Sheet]) -> Iterator[tuple[str, bytes]]:
    from kgcp.io.print.dxf import dxf_of

    yield "", dxf_of(sheets[0].artwork)


def _pngs(sheets: Sequence[Sheet], name: str, dpi: int) -> Iterator[tuple[str, bytes]]:
    from kgcp.io.print.pdf import pdf_of
    from kgcp.io.print.png import pngs_of

    pictures = pngs_of(pdf_of(sheets, f"Target {name}"), dpi)
    yield from ((s.label, picture) for s, picture in zip(sheets, pictures, strict=True))
