"""Text exports of NovAtel's Waypoint programs, Inertial Explorer and GrafNav.

A header of lines `key: value` comes first. The names of the columns follow, their units in
parentheses below, and the epochs. Users choose the columns and the mark between them, by default
blanks; names and units then end at the same place of their lines. (Waypoint Software User Manual
OM-20000166, "Export Wizard" and "Output Variables".)
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice, takewhile

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.safe_read import LARGEST
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.rtklib_pos import sexagesimal_deg

_PROGRAM = re.compile(r"^\s*Program:.*\b(?:Inertial Explorer|GrafNav)\b", re.MULTILINE)
_UNIT = re.compile(r"\([^()]*\)")
_UNITS = re.compile(r"(?:[\s,;]*\([^()]*\))+[\s,;]*")
_KEY = re.compile(r"\s*([A-Za-z][\w /]*?):\s*(.*?)\s*")
_SCALING = re.compile(r"\s*SD\b.*\bScaling Settings", re.IGNORECASE)
_SCALE = re.compile(r"\s*(Position|Attitude):\s*(.*?)\s*", re.IGNORECASE)
_EPOCH = re.compile(r"\s*[-+]?\d")
_SEXAGESIMAL = re.compile(r"\((?:\+/-)?D M S\)", re.IGNORECASE)
_NAMES_WITH_BLANKS = ("Project Name",)
_AGAIN = "export it again"


@dataclass(frozen=True, slots=True)
class WaypointColumn:
    """A column of the table."""

    unit: str  # without parentheses, for example `deg`, `+/-D M S`; empty: none
    texts: Sequence[str]  # of every epoch; sexagesimal angles are three numbers


@dataclass(frozen=True, slots=True, eq=False)
class WaypointExport:
    """The epochs of an export."""

    file: ForeignFile
    lines: tuple[int, ...]  # line of each epoch in the file, from 1
    header: Mapping[str, str]  # for example `Datum` and `Source`
    scales: Mapping[str, str]  # of the standard deviations of `Position` and `Attitude`
    columns: Mapping[str, WaypointColumn]  # by the names in the file

    def numbers(self, name: str, unit: str) -> FloatArray:
        """Return the numbers (n,) of a column; angles in `deg` may be written in D M S.

        Raises
        ------
        KgcpError
            If they have another unit, or a cell is not a number.
        """
        column = self.columns[name]
        is_sexagesimal = unit == "deg" and _SEXAGESIMAL.fullmatch(f"({column.unit})") is not None
        if column.unit.lower() != unit and not is_sexagesimal:
            raise self.file.error(
                f"gives {name} in {column.unit or 'no unit'}", f"export it in {unit}"
            )
        try:
            values = _parsed(column.texts, is_sexagesimal=is_sexagesimal)
        except ValueError:
            values = np.full(len(column.texts), np.nan)
            for row, text in enumerate(column.texts):
                with suppress(ValueError):
                    values[row] = _parsed([text], is_sexagesimal=is_sexagesimal)[0]
        wrong = np.flatnonzero(~(np.abs(values) < LARGEST))
        if wrong.size:
            text = column.texts[wrong[0]]
            raise self.error_at(
                int(wrong[0]), f"{name} {text!r} is not a number", "repair the line"
            )
        return values

    def error_at(self, row: int, problem: str, remedy: str = _AGAIN) -> KgcpError:
        """Return the error for an epoch, to be raised."""
        return self.file.error_at(f"line {self.lines[row]}", problem, remedy)


def looks_like_waypoint(file: ForeignFile) -> bool:
    """Return whether the header names one of the programs."""
    return _PROGRAM.search(file.head.decode("utf-8-sig", errors="replace")) is not None


def read_export(file: ForeignFile) -> WaypointExport:
    """Read header and epochs of an export.

    Raises
    ------
    KgcpError
        If it lacks the lines of names and units, a column has two units, or an epoch has another
        number of cells.
    """
    rows = file.text.splitlines()
    below = next((i for i, row in enumerate(rows) if i and _UNITS.fullmatch(row)), None)
    if below is None or not rows[below - 1].strip():
        raise file.error(
            "lacks the lines with the names of its columns and their units",
            "export it with its header",
        )
    separator = next((mark for mark in ",;\t" if mark in rows[below - 1]), None)
    units = _units(file, rows[below - 1], rows[below], separator)
    first = next((i for i in range(below + 1, len(rows)) if rows[i].strip()), len(rows))
    epochs = list(takewhile(_EPOCH.match, rows[first:]))
    widths = [3 if _SEXAGESIMAL.fullmatch(unit) else 1 for _, unit in units]
    cells = [
        _cells(file, number, row, widths, separator)
        for number, row in enumerate(epochs, start=first + 1)
    ]
    for number, row in enumerate(rows[first + len(epochs) :], start=first + len(epochs) + 1):
        if epochs and _EPOCH.match(row) and len(row.split()) == len(epochs[-1].split()):
            raise file.error_at(
                f"line {number}", "is an epoch that follows lines that are not", _AGAIN
            )
    columns: dict[str, WaypointColumn] = {}
    by_column = zip(*cells, strict=True) if cells else ((),) * len(units)
    for (name, unit), texts in zip(units, by_column, strict=True):
        # of two columns with one name, such as seconds of the week and of the day, the first counts
        columns.setdefault(name, WaypointColumn(unit.strip("()"), texts))
    return WaypointExport(
        file,
        tuple(range(first + 1, first + len(epochs) + 1)),
        {match[1]: match[2] for row in rows[:below] if (match := _KEY.fullmatch(row))},
        _scales(rows[:below]),
        columns,
    )


def _units(
    file: ForeignFile, names_row: str, units_row: str, separator: str | None
) -> list[tuple[str, str]]:
    """Return name and unit, in parentheses, of every column."""
    if separator is not None:
        names = [name.strip() for name in names_row.split(separator)]
        units = [unit.strip() for unit in units_row.split(separator)]
        return list(zip(names, units + [""] * (len(names) - len(units)), strict=False))
    for name in _NAMES_WITH_BLANKS:
        names_row = names_row.replace(name, name.replace(" ", "_"))
    words = list(re.finditer(r"\S+", names_row))
    units = [""] * len(words)
    ends = np.array([word.end() for word in words])
    for unit in _UNIT.finditer(units_row):
        nearest = int(np.argmin(np.abs(ends - unit.end())))
        if units[nearest]:
            raise file.error(
                f"has the units {units[nearest]} and {unit.group()} for its column"
                f" {words[nearest].group()}",
                "export it with commas between the columns",
            )
        units[nearest] = unit.group()
    return [(word.group(), unit) for word, unit in zip(words, units, strict=True)]


def _cells(
    file: ForeignFile, line: int, row: str, widths: Sequence[int], separator: str | None
) -> list[str]:
    """Return the text of every column; `widths`: of how many words, between blanks."""
    texts = row.split(separator)
    if separator is not None:
        texts = [text.strip() for text in texts]
        if len(texts) == len(widths) + 1 and not texts[-1]:
            del texts[-1]  # the separator also ends the line
    elif len(texts) == sum(widths) != len(widths):
        words = iter(texts)
        texts = [" ".join(islice(words, width)) for width in widths]
    if len(texts) != len(widths):
        raise file.error_at(
            f"line {line}", "does not have one cell for each column", "repair the line"
        )
    return texts


def _scales(rows: Sequence[str]) -> dict[str, str]:
    """Return by what the program multiplied the standard deviations, in its words."""
    start = next((i for i, row in enumerate(rows) if _SCALING.match(row)), len(rows))
    found = (_SCALE.fullmatch(row) for row in rows[start : start + 4])
    return {match[1].capitalize(): match[2] for match in found if match}


def _parsed(texts: Sequence[str], *, is_sexagesimal: bool) -> FloatArray:
    """Return numbers, or angles of degrees, minutes and seconds [deg]."""
    if is_sexagesimal:
        return sexagesimal_deg(np.array([[*map(float, text.split())] for text in texts]))
    return np.array([*map(float, texts)])
