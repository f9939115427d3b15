"""Lists of frames to leave out, written by hand or by the contact sheet."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.csv_columns import frame_name
from kgcp.io.files.safe_read import is_file, read_lines

_COLUMNS = ("flight", "frame", "target")
_UNNAMED = ("frame", "target")  # of a file without a header


@dataclass(frozen=True, slots=True)
class Exclusion:
    """One line of a list."""

    flight: str  # its name; empty: any
    frame: str  # path below the frames folder
    target: str  # empty: all

    def __str__(self) -> str:
        return ", ".join(filter(None, (self.flight, self.frame, self.target)))


def read_exclusions(path: Path) -> tuple[Exclusion, ...]:
    """Read a list with a frame, or frame and target, in every line; `#` begins a comment.

    A first line of the column names `flight`, `frame` and `target` may give another order and add
    the flight. Cells are separated by commas or semicolons.

    Raises
    ------
    KgcpError
        If the file is missing, or a line has no frame or too many cells. The message names the
        line.
    """
    if not is_file(path):
        raise KgcpError(f"{path}: does not exist; name a file of frames to leave out")
    rows = [(number, cells) for number, cells in _rows(path) if cells]
    columns: Sequence[str] = _UNNAMED
    if rows and "frame" in rows[0][1] and set(rows[0][1]) <= set(_COLUMNS):
        columns, rows = rows[0][1], rows[1:]
    return tuple(_exclusion(path, number, columns, cells) for number, cells in rows)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(read_lines(path, "the list of frames to leave out"), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            separator = ";" if ";" in text and "," not in text else ","
            try:
                cells = [cell.strip() for cell in next(csv.reader([text], delimiter=separator))]
            except csv.Error as error:
                raise KgcpError(f"{path}, line {number}: {error}; repair the line") from error
            while cells and not cells[-1]:
                cells.pop()  # empty cells that spreadsheets add
            yield number, cells


def _exclusion(path: Path, line: int, columns: Sequence[str], cells: Sequence[str]) -> Exclusion:
    if len(cells) > len(columns):
        raise KgcpError(
            f"{path}, line {line}: has {len(cells)} cells; give a frame, or a frame and a target"
        )
    values = dict(zip(columns, cells, strict=False))
    frame = frame_name(values["frame"]) if "frame" in values else ""
    if not frame:
        raise KgcpError(f"{path}, line {line}: names no frame; repair or delete the line")
    return Exclusion(values.get("flight", ""), frame, values.get("target", ""))
