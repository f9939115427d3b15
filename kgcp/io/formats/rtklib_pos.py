"""RTKLIB's solution files: `.pos` of trajectories and `_events.pos` of time marks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.gps_time import TimeSystem, clock_from_week, unix_from_clock, unwrap_week
from kgcp.io.files.safe_read import LARGEST, read_lines
from kgcp.io.files.sniff import ForeignFile

_COLUMNS = re.compile(r"%\s*(GPST|UTC|JST)\b(.*)")
_NAME = re.compile(r"([A-Za-z][\w-]*)(?:\(([^()]*)\))?")
_HEIGHTS = re.compile(r"lat/lon/height=(\w+)/(\w+)")
_DATE = re.compile(r"(\d{4})/(\d{1,2})/(\d{1,2})\s+(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)")
_JST_AHEAD_S = 9.0 * 3600.0
_SEXAGESIMAL = "d'\""  # degrees, minutes, seconds in three cells


@dataclass(frozen=True, slots=True, eq=False)
class RtklibSolution:
    """The rows of a solution file."""

    path: Path
    lines: tuple[int, ...]  # line of each row in the file, from 1
    time_s: FloatArray  # (n,): Unix time, UTC [s]
    # by the header's names without units, angles in degrees: `latitude`, `x-ecef`, `sdn`, …
    columns: Mapping[str, FloatArray]
    # from the header, for example `WGS84` and `ellipsoidal`; empty if it has none
    datum: str
    heights: str


def looks_like_solution(file: ForeignFile) -> bool:
    """Return whether a file is a solution, with or without its header."""
    text = file.head.decode("utf-8", errors="replace").lstrip("\ufeff \t\r\n")
    is_header = text.startswith("%") and not text.startswith("%YAML")
    return is_header or _DATE.match(text) is not None


def read_solution(file: ForeignFile) -> RtklibSolution:
    """Read the rows of a solution file by its own header.

    Raises
    ------
    KgcpError
        If there is no header, a row is too short, or a cell is not a number.
    """
    lines = enumerate(read_lines(file.path, file.toml_key), start=1)
    rows = [(number, row.strip()) for number, row in lines if row.strip()]
    header = next((match for _, row in rows if (match := _COLUMNS.match(row))), None)
    if header is None:
        raise file.error(
            "lacks the header line '% GPST …' that names its columns",
            "write the solution with its header (out-outhead = on), or put that of another solution"
            " above it if columns, time system and datum are the same, as in a receiver's own log",
        )
    names = _NAME.findall(header[2])
    width = sum(3 if unit == _SEXAGESIMAL else 1 for _, unit in names)
    data = [(line, row) for line, row in rows if not row.startswith("%")]
    clocks, cells = _clocks_and_cells(file, data, width)
    # Time systems (manual, appendix B): GPS time, UTC, or that of Japan, which is UTC + 9 h.
    system = TimeSystem.GPS if header[1] == "GPST" else TimeSystem.UTC
    time_s = unix_from_clock(clocks, system) - (_JST_AHEAD_S if header[1] == "JST" else 0.0)
    datum_and_heights = next((match for _, row in rows if (match := _HEIGHTS.search(row))), None)
    return RtklibSolution(
        file.path,
        tuple(line for line, _ in data),
        time_s,
        _columns(names, cells),
        datum_and_heights[1] if datum_and_heights else "",
        datum_and_heights[2] if datum_and_heights else "",
    )


def _columns(names: Sequence[tuple[str, str]], cells: FloatArray) -> dict[str, FloatArray]:
    """Return cells (n, width) by name."""
    columns, first = {}, 0
    for name, unit in names:
        if unit == _SEXAGESIMAL:
            columns[name] = sexagesimal_deg(cells[:, first : first + 3])
            first += 3
        else:
            columns[name] = cells[:, first]
            first += 1
    return columns


def sexagesimal_deg(parts: FloatArray) -> FloatArray:
    """Return angles (n,) of degrees, minutes and seconds (n, 3); the sign stands at the degrees."""
    degrees, minutes, seconds = parts.T
    size = np.abs(degrees) + minutes / 60.0 + seconds / 3600.0
    return np.asarray(np.copysign(size, degrees))


def _clocks_and_cells(
    file: ForeignFile, data: Sequence[tuple[int, str]], width: int
) -> tuple[FloatArray, FloatArray]:
    """Return clock times (n,) and cells (n, width); further cells are dropped."""
    separator = next((mark for mark in ",;\t" if data and mark in data[0][1]), None)
    clocks, cells = np.empty(len(data)), np.empty((len(data), width))
    weeks = np.full(len(data), np.nan)
    for index, (line, row) in enumerate(data):
        try:
            if match := _DATE.match(row):
                clocks[index], remainder = _calendar(match), row[match.end() :]
                texts = remainder.removeprefix(separator or "").split(separator)
            else:
                week, seconds, *texts = row.split(separator)
                weeks[index], clocks[index] = int(week), float(seconds)
            if len(texts) < width:
                raise file.error_at(
                    f"line {line}",
                    f"has {len(texts)} cells after the time, but the header names {width}",
                    "repair the line",
                )
            cells[index] = [float(text) for text in texts[:width]]
        except (ValueError, OverflowError) as error:
            raise file.error_at(
                f"line {line}", f"is not a time and numbers ({error})", "repair the line"
            ) from error
    in_weeks = ~np.isnan(weeks)
    if in_weeks.any():
        clocks = np.where(in_weeks, clock_from_week(weeks, clocks), clocks)
    invalid = np.flatnonzero(~(np.abs(np.column_stack((clocks, cells))) < LARGEST).all(axis=1))
    if invalid.size:
        line = data[invalid[0]][0]
        raise file.error_at(f"line {line}", "holds a number that is not finite", "delete it")
    return unwrap_week(clocks) if in_weeks.any() else clocks, cells


def _calendar(match: re.Match[str]) -> float:
    year, month, day, hour, minute = (int(match[group]) for group in range(1, 6))
    midnight = datetime(year, month, day, tzinfo=UTC).timestamp()
    return midnight + 3600.0 * hour + 60.0 * minute + float(match[6])
