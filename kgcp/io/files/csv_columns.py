"""Tables as text whose columns are known by name: texts and numbers.

They are comma-separated with decimal points, unless a `CsvLayout` says otherwise.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.csv_text import is_separator_line
from kgcp.io.files.safe_read import is_sound, read_lines

SEPARATOR_REMEDY = "save it with commas between the cells and points in the numbers"
"""What to do with a file whose cells are not separated by commas."""

_SEPARATORS = ((r";", "';'"), (r"\t", "tabs"), (r" +", "spaces"))
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")

SEPARATORS = (",", ";", "\t", " ")
"""What may stand between the cells of a file; several spaces count as one."""
DECIMALS = (".", ",")
"""What may stand before the decimals of a number."""


@dataclass(frozen=True, slots=True)
class CsvLayout:
    """How a file writes its table; by default as docs/foreign_files.md says."""

    separator: str = ","
    decimal: str = "."
    # name in docs/foreign_files.md → name in the file's first line; the others are the same in both
    columns: Mapping[str, str] = field(default_factory=dict)


_OWN_LAYOUT = CsvLayout()


@dataclass(frozen=True, slots=True, eq=False)
class CsvColumns:
    """The wanted columns of one file, row by row."""

    path: Path
    lines: tuple[int, ...]  # line of each row in the file, from 1
    texts: Mapping[str, tuple[str, ...]]  # the text columns by name
    names: tuple[str, ...]  # names of the number columns that the file has
    numbers: FloatArray  # (n, len(names): their values, all finite

    def frames(self) -> tuple[str, ...]:
        """Return the column frame, as `frame_name` writes it.

        Raises
        ------
        KgcpError
            With the line, if a frame is empty or given twice.
        """
        first_lines: dict[str, int] = {}
        for line, text in zip(self.lines, self.texts["frame"], strict=True):
            frame = frame_name(text)
            if not frame:
                raise KgcpError(f"{self.path}, line {line}: names no frame; repair the line")
            if first_lines.setdefault(frame, line) != line:
                raise KgcpError(
                    f"{self.path}, line {line}: frame {frame!r} is also in line"
                    f" {first_lines[frame]}; keep one of them"
                )
        return tuple(first_lines)

    def block(self, names: Sequence[str]) -> FloatArray:
        """Return columns (n, len(names)) by name."""
        return self.numbers[:, [self.names.index(name) for name in names]]

    def optional_block(self, names: Sequence[str]) -> FloatArray | None:
        """Return optional columns (n, len(names)); None if the file has none of them.

        Raises
        ------
        KgcpError
            If the file has only some of them.
        """
        present = [name for name in names if name in self.names]
        if not present:
            return None
        absent = [name for name in names if name not in self.names]
        if absent:
            raise KgcpError(
                f"{self.path}, line 1: has {', '.join(present)} but not {', '.join(absent)};"
                " give all of them or none"
            )
        return self.block(names)

    def deviations(self, names: Sequence[str]) -> FloatArray | None:
        """Return optional columns of standard deviations; None if the file has none of them."""
        block = self.optional_block(names)
        if block is None:
            return None
        negative = np.argwhere(block < 0.0)
        if negative.size:
            row, column = negative[0]
            raise KgcpError(
                f"{self.path}, line {self.lines[row]}: {names[column]} is"
                f" {block[row, column]:g}; a standard deviation is not negative"
            )
        return block


def frame_name(text: str) -> str:
    r"""Return a frame's name as `list_frames` has it: `./a\b.jpg` is `a/b.jpg`."""
    return text.replace("\\", "/").removeprefix("./")


def read_csv_columns(
    path: Path,
    texts: Sequence[str],
    required: Sequence[str],
    optional: Sequence[str],
    toml_key: str,
    layout: CsvLayout = _OWN_LAYOUT,
) -> CsvColumns:
    """Read text columns and number columns, in any order; other columns are ignored.

    Parameters
    ----------
    path : Path
        The file: UTF-8, first line names the columns.
    texts : sequence of str
        Names of text columns; the file must have all of them.
    required, optional : sequence of str
        Names of number columns.
    toml_key : str
        Where flight.toml names the file, for the message if it is missing.
    layout : CsvLayout
        Of the file; columns have their names of docs/foreign_files.md in all other arguments and in
        the result.

    Raises
    ------
    KgcpError
        With the line: missing file or column, a cell that is not a finite number, a short row.
    """
    wanted = (*texts, *required)
    rows = _read_rows(path, toml_key, layout.separator)
    first = next(rows, None)
    if first is None:
        raise KgcpError(f"{path}: is empty; its first line must name {', '.join(wanted)}")
    header = _own_names([name.strip() for name in first[1]], layout, f"{path}, line {first[0]}")
    _check_header(header, wanted, f"{path}, line {first[0]}")
    names = tuple(name for name in (*required, *optional) if name in header)
    text_places = [header.index(name) for name in texts]
    places = [header.index(name) for name in names]
    lines, text_cells, numbers = [], [], array("d")
    for line, cells in rows:
        while len(cells) > len(header) and not cells[-1].strip():
            cells.pop()  # a spreadsheet has as many cells in some lines as in the longest one
        if len(cells) != len(header):
            raise KgcpError(
                f"{path}, line {line}: has {len(cells)} cells, the first line has {len(header)};"
                f" {_remedy_for(cells, header)}"
            )
        lines.append(line)
        text_cells.append([cells[place].strip() for place in text_places])
        number_cells = [cells[place] for place in places]
        values = _sound_numbers(number_cells) if layout.decimal == "." else None
        numbers.extend(
            values
            or [
                _number(cell, f"{path}, line {line}: {name}", layout.decimal)
                for cell, name in zip(number_cells, names, strict=True)
            ]
        )
    columns = zip(*text_cells, strict=True) if text_cells else [()] * len(texts)
    block = np.array(numbers).reshape(len(lines), len(names))
    return CsvColumns(path, tuple(lines), dict(zip(texts, columns, strict=True)), names, block)


def foreign_separator(first_line: str, names: Sequence[str]) -> str | None:
    """Return what separates the names in a first line that has no commas, in words.

    Parameters
    ----------
    names : sequence of str
        Of which the line must have one; None is returned for any other line.
    """
    for separator, words in _SEPARATORS:
        cells = [cell.strip().strip('"') for cell in re.split(separator, first_line.strip())]
        if len(cells) > 1 and not set(cells).isdisjoint(names):
            return words
    return None


def _remedy_for(cells: Sequence[str], header: Sequence[str]) -> str:
    """Return what to do about a row with more or less cells than the header."""
    if len(cells) > len(header) and any(cell.strip().isdigit() for cell in cells[1:]):
        return "write decimal points, not commas, or repair the line"
    return "repair the line"


def _check_header(header: Sequence[str], wanted: Sequence[str], where: str) -> None:
    lacking = [name for name in wanted if name not in header]
    if lacking and header[0].startswith("#"):
        raise KgcpError(
            f"{where}: begins with '#'; delete comments, and a '#' before the names of the columns"
        )
    separator = foreign_separator(header[0], wanted) if lacking and len(header) == 1 else None
    if separator is not None:
        raise KgcpError(f"{where}: its cells are separated by {separator}; {SEPARATOR_REMEDY}")
    if lacking:
        raise KgcpError(
            f"{where}: lacks the columns {', '.join(lacking)};"
            f" the first line must name {', '.join(wanted)}"
        )
    doubled = sorted({name for name in header if name and header.count(name) > 1})
    if doubled:
        raise KgcpError(f"{where}: names {doubled[0]} twice; keep one of them")


def _own_names(header: Sequence[str], layout: CsvLayout, where: str) -> list[str]:
    """Return the first line with the names of docs/foreign_files.md, as the layout translates."""
    own = {theirs: ours for ours, theirs in layout.columns.items()}
    for theirs, ours in own.items():
        if theirs not in header:
            raise KgcpError(
                f"{where}: has no column {theirs!r}, which flight.toml names for {ours};"
                f" name one of {', '.join(header)}"
            )
    # A column of the same name that stands for nothing must not be taken for the translated one.
    return [own.get(name, "" if name in layout.columns else name) for name in header]


def _read_rows(path: Path, toml_key: str, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, with their line numbers."""
    lines = _without_separator_line(read_lines(path, toml_key))
    if separator == " ":
        rows = ((number, line.split()) for number, line in enumerate(lines, start=1))
        yield from ((number, cells) for number, cells in rows if cells)
        return
    reader = csv.reader(lines, delimiter=separator)
    try:
        yield from ((reader.line_num, cells) for cells in reader if any(map(str.strip, cells)))
    except csv.Error as error:
        raise KgcpError(f"{path}: is not a readable CSV file ({error}); repair it") from error


def _without_separator_line(lines: Iterator[str]) -> Iterator[str]:
    """Yield the lines, the first one blank if it names the separator: others keep their numbers."""
    first = next(lines, "")
    yield "\n" if is_separator_line(first) else first
    yield from lines


def _sound_numbers(cells: Sequence[str]) -> list[float] | None:
    """Return the numbers of a row with decimal points; None if one of them may be unusable.

    It spares long files `_number`, cell by cell: 200,000 epochs take 1.5 instead of 3.1 s.
    """
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        return None
    # a sum is no number if one of its terms is none
    return values if is_sound(sum(map(abs, values))) else None


def _number(text: str, where: str, decimal: str) -> float:
    text = text.strip()
    try:
        value = float(text.replace(decimal, "."))
    except ValueError:
        value = float("nan")
    if decimal == "." and _DECIMAL_COMMA.fullmatch(text):
        raise KgcpError(f"{where} is {text!r}, with a decimal comma; write a point")
    if decimal == "," and "." in text:  # 1.234 would be read as 1,234
        raise KgcpError(
            f"{where} is {text!r}, with a point, but decimals have a comma in this file; leave out"
            " points between thousands"
        )
    if not is_sound(value):
        raise KgcpError(f"{where} is {text!r}; give a finite number")
    return value
