"""When the frames were taken: a table of times, or the marks that a receiver made of exposures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path, PurePosixPath

import numpy as np

from kgcp.errors import KgcpError
from kgcp.io.files.gps_time import clock_from_week, unix_from_gps, unwrap_week
from kgcp.io.files.safe_read import is_file, read_lines
from kgcp.io.files.time_text import is_in_calendar
from kgcp.io.formats.rtklib_pos import looks_like_solution, read_solution
from kgcp.io.images.frames import read_frame_times

_HEAD = 4096
# Number, GPS seconds of the week, [week]; positions and their deviations follow.
_MARK = re.compile(r"(\d{1,9})\s+(\d{1,9}(?:\.\d*)?)\s+\[\s*(\d{1,9})\s*\](?:\s|$)")
_LAST_NUMBER = re.compile(r"(.*?)(\d+)\D*")


class TimesFormat(StrEnum):
    """A notation of frame times, by its name in flight.toml."""

    CSV = "csv"
    MRK = "mrk"
    RTKLIB = "rtklib"


def read_times(
    path: Path, frames: Sequence[str], times_format: TimesFormat | None = None
) -> dict[str, float]:
    """Read the times of frames, in any of the formats of docs/conventions.md.

    Parameters
    ----------
    path : Path
    frames : sequence of str
        Names of all frames, sorted.
    times_format : TimesFormat or None
        None: the content tells.

    Returns
    -------
    dict of float
        Unix seconds (UTC) by frame; entries that belong to no frame by what they are called in
        the file.

    Raises
    ------
    KgcpError
        Naming file and line: it is missing or wrong, or its marks cannot be told to frames.
    """
    kind = times_format or recognise(path)
    if kind is TimesFormat.CSV:
        return read_frame_times(path)
    if kind is TimesFormat.MRK:
        times = _join_by_number(path, _read_marks(path), frames)
    else:
        times = _join_by_order(path, frames)
    if not all(map(is_in_calendar, times.values())):
        raise KgcpError(f"{path}: has weeks that no calendar has; give the file of this flight")
    return times


def recognise(path: Path) -> TimesFormat:
    """Tell the format of frame times by the content; what is no other is CSV."""
    if not is_file(path):
        return TimesFormat.CSV  # whose reader says what is wrong
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    if _MARK.match(head.decode("utf-8-sig", errors="replace").lstrip()):
        return TimesFormat.MRK
    return TimesFormat.RTKLIB if looks_like_solution(head) else TimesFormat.CSV


def _read_marks(path: Path) -> dict[int, float]:
    """Return Unix times by the numbers of DJI's marks.

    Their positions are the antenna's, and the offsets to the sensor beside it (north, east and
    **down**, mm) are of the drone: a vehicle's target needs neither.
    """
    numbers, clocks = [], []
    first_lines: dict[int, int] = {}
    for line, row in enumerate(read_lines(path, "[frames] times"), start=1):
        if not row.strip():
            continue
        match = _MARK.match(row.strip())
        if match is None:
            raise KgcpError(
                f"{path}, line {line}: does not begin with number, GPS seconds and [week];"
                " repair the line"
            )
        number = int(match[1])
        if number in first_lines:
            raise KgcpError(
                f"{path}, line {line}: number {number} stands in line {first_lines[number]}, too;"
                " give the marks of one flight"
            )
        first_lines[number] = line
        numbers.append(number)
        clocks.append(clock_from_week(np.array(float(match[3])), np.array(float(match[2]))))
    if not numbers:
        raise KgcpError(f"{path}: holds no marks; give the Timestamp.MRK of this flight")
    times = unix_from_gps(unwrap_week(np.array(clocks)))
    return dict(zip(numbers, times.tolist(), strict=True))


def _join_by_number(path: Path, marks: dict[int, float], frames: Sequence[str]) -> dict[str, float]:
    times = {}
    owners: dict[int, tuple[str, str]] = {}
    for frame in frames:
        match = _LAST_NUMBER.fullmatch(PurePosixPath(frame).stem)
        if match is None or int(match[2]) not in marks:
            continue
        number = int(match[2])
        before = str(PurePosixPath(frame).parent / match[1])
        other, other_before = owners.setdefault(number, (frame, before))
        if before != other_before:
            raise KgcpError(
                f"{path}: its number {number} may be that of {other!r} or of {frame!r}; give the"
                " frames of one flight, or frames.csv"
            )
        times[frame] = marks[number]
    if not times:
        raise KgcpError(
            f"{path}: none of its {len(marks)} numbers is the last number in the name of a frame"
            f" ({frames[0]!r}, …); give the marks of this flight, or frames.csv"
        )
    spare = {str(number): time for number, time in marks.items() if number not in owners}
    return {**spare, **times}


def _join_by_order(path: Path, frames: Sequence[str]) -> dict[str, float]:
    solution = read_solution(path, "[frames] times")
    if len(solution.time_s) != len(frames):
        raise KgcpError(
            f"{path}: has {len(solution.time_s)} events for {len(frames)} frames, and nothing tells"
            " which belong together (RTKLIB keeps one event per epoch of observations and loses"
            " the others); add or remove frames that differ, or give frames.csv"
        )
    backwards = np.flatnonzero(np.diff(solution.time_s) <= 0.0)
    if backwards.size:
        line = solution.lines[int(backwards[0]) + 1]
        raise KgcpError(f"{path}, line {line}: its event is not later than that before; sort them")
    return dict(zip(frames, solution.time_s.tolist(), strict=True))
