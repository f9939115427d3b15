"""Lists of points as AICON, MicMac and others write them: name, x, y, z and perhaps deviations.

White space, commas or semicolons separate them. The first line may be a heading. Three deviations
of 0 mean none. Such a list states neither its unit nor the diameter of the discs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from kgcp.errors import KgcpError
from kgcp.io.files.safe_read import is_number
from kgcp.io.files.sniff import ForeignFile
from kgcp.targets.fields.layout import LEAST_POINTS
from kgcp.targets.fields.points import MOST_DISCS, FieldPoint, PointField, gaps_between

_SEPARATORS = re.compile(r"[\s,;]+")
_COMMENTS = ("#", "!", "%", "//")
_DISC = 0.3  # of the distance of neighbours: assumed diameter until it is measured
_MAX_DISC = 0.5  # of the smallest distance
_HEAD = 4096  # characters by which the format is recognised
_COUNTS = (4, 7)  # cells in a row: without and with deviations


def matches(file: ForeignFile) -> bool:
    """Whether the first lines are names with three or six numbers."""
    lines = file.text[:_HEAD].splitlines()
    complete_lines = lines[:-1] if len(file.text) > _HEAD else lines
    rows = _below_heading(list(_cells(enumerate(complete_lines, 1))))
    return len(rows) >= LEAST_POINTS and all(_is_point(cells) for _, cells in rows)


def field(file: ForeignFile, unit_m: float | None) -> PointField:
    """Return the points as a field."""
    rows = _below_heading(list(_cells(enumerate(file.text.splitlines(), 1))))
    if len(rows) > MOST_DISCS:
        raise file.error(f"has {len(rows)} points", f"keep at most {MOST_DISCS}")
    for line, cells in rows:
        if not _is_point(cells):
            raise file.error_at(f"line {line}", "is not name, x, y, z", "repair or delete it")
    if unit_m is None:
        raise KgcpError(
            f"{file.path}: does not state its unit; state what its coordinates are in",
            option="unit",
        )
    if not rows:
        raise file.error("has no points", "name a list of name, x, y, z")
    values = unit_m * np.array([[float(cell) for cell in cells[1:4]] for _, cells in rows])
    gaps_m = gaps_between(values).min(axis=1)
    pitch_m, min_gap_m = float(np.median(gaps_m)), float(gaps_m.min())
    if not 0.0 < pitch_m < math.inf:
        raise file.error("has points at one place", "repair it")
    diameter_m = _DISC * pitch_m
    if min_gap_m > 0.0:  # two discs at one place overlap whatever their diameter
        diameter_m = min(diameter_m, _MAX_DISC * min_gap_m)
    points = []
    for (_, cells), place in zip(rows, values.tolist(), strict=True):
        sds = [unit_m * float(cell) for cell in cells[4:7]]
        sd_m = (sds[0], sds[1], sds[2]) if any(sds) else None
        points.append(FieldPoint(cells[0], (place[0], place[1], place[2]), diameter_m, sd_m=sd_m))
    return PointField(file.path.stem, tuple(points), is_diameter_stated=False)


def _cells(lines: enumerate[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the numbers and cells of lines that are neither blank nor comments."""
    for number, line in lines:
        text = line.strip()
        if text and not text.startswith(_COMMENTS):
            yield number, _SEPARATORS.split(text)


def _below_heading(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return the rows without names of columns: a first row in which no cell is a number."""
    has_heading = bool(rows) and not any(map(is_number, rows[0][1]))
    return rows[1:] if has_heading else rows


def _is_point(cells: list[str]) -> bool:
    is_named = cells[0] != "" and cells[0].isprintable()
    return is_named and len(cells) in _COUNTS and all(map(is_number, cells[1:]))
