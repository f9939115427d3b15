"""How a table of another program is written: separator, decimal mark, names of its columns."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from kgcp.io.files.csv_columns import SEPARATORS, CsvLayout
from kgcp.io.files.csv_text import is_separator_line
from kgcp.io.files.safe_read import is_sound
from kgcp.io.files.sniff import ForeignFile

_UNIT = re.compile(r"[(\[{]([^)\]}]*)[)\]}]")
_OTHER_UNITS = {
    "rad",
    "radian",
    "radians",
    "gon",
    "grad",
    "arcmin",
    "arcsec",
    "mm",
    "cm",
    "ft",
    "feet",
}
_COMMA_NUMBER = re.compile(r"[-+]?\d+,\d+")
_SAMPLE = 20  # rows by which the decimal mark is told


@dataclass(frozen=True, slots=True)
class SniffedTable:
    """The table of a file, as its first lines show it."""

    layout: CsvLayout  # which translates every known column whose name differs
    cells: Mapping[str, str]  # of the first row, by the names of docs/foreign_files.md
    header: tuple[str, ...]  # names in the file

    def name_of(self, column: str) -> str:
        """Return what the file calls a column."""
        return self.layout.columns.get(column, column)

    def number(self, column: str) -> float | None:
        """Return a cell of the first row; None where it is not a finite number."""
        try:
            value = float(self.cells[column].replace(self.layout.decimal, "."))
        except (KeyError, ValueError):
            return None
        return value if is_sound(value) else None


def sniff_table(file: ForeignFile, known: Mapping[str, Sequence[str]]) -> SniffedTable | None:
    """Return how a file writes its table; None where its first line names no known column.

    Columns whose name gives a unit that kgcp does not take (radians, millimetres, feet) are not
    known.

    Parameters
    ----------
    known : mapping
        Name in docs/foreign_files.md → what others call it, in lower case without blanks, marks and
        units. The name itself need not be among them.
    """
    rows = _first_rows(file)
    tables = {separator: _cells(rows, separator) for separator in SEPARATORS}
    separator = max(tables, key=lambda mark: len(_columns(tables[mark][0], known)))
    header, *others = tables[separator]
    columns = _columns(header, known)
    if len(columns) < 2 or not others:
        return None
    places = {ours: header.index(theirs) for ours, theirs in columns.items()}
    return SniffedTable(
        CsvLayout(
            separator,
            _decimal(others, separator, [*places.values()]),
            {ours: theirs for ours, theirs in columns.items() if ours != theirs},
        ),
        {ours: others[0][place] for ours, place in places.items() if place < len(others[0])},
        tuple(header),
    )


def _first_rows(file: ForeignFile) -> list[str]:
    """Return the first lines that are not blank; none of a file that begins like another format."""
    text = "" if b"\0" in file.head else file.head.decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    if not text.endswith("\n"):
        lines = lines[: max(2, len(lines) - 1)]  # the last one may be cut
    rows = [line for line in lines if line.strip()]
    rows = rows[1 if rows and is_separator_line(rows[0]) else 0 :][: _SAMPLE + 1]
    return [] if not rows or rows[0].lstrip()[0] in "#%<{" else rows


def _cells(rows: Sequence[str], separator: str) -> list[list[str]]:
    """Return the rows as cells; at least one row."""
    if separator == " ":
        return [row.split() for row in rows] or [[]]
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(rows, delimiter=separator)]
    except csv.Error:
        table = []
    return table or [[]]


def _columns(header: Sequence[str], known: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return the known columns, each with its name in the file; exact names go first."""
    exact = {name: name for name in known if name in header}
    for theirs in header:
        unit = _UNIT.search(theirs)
        if theirs in exact or (unit is not None and unit[1].strip().lower() in _OTHER_UNITS):
            continue
        plain = re.sub(r"[\W_]", "", _UNIT.sub("", theirs).casefold())
        ours = next((name for name, others in known.items() if plain in others), None)
        if ours is not None and ours not in exact:
            exact[ours] = theirs
    return {name: exact[name] for name in known if name in exact}


def _decimal(rows: Sequence[Sequence[str]], separator: str, places: Sequence[int]) -> str:
    """Return the decimal mark of known columns; others may be lists or texts."""
    if separator == ",":
        return "."
    cells = (row[place] for row in rows for place in places if place < len(row))
    has_comma = any(map(_COMMA_NUMBER.fullmatch, cells))
    return "," if has_comma else "."
