"""Times of the frames: a table, or the marks of exposures that a receiver recorded."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.csv_columns import CsvColumns, read_csv_columns
from kgcp.io.files.gps_time import clock_from_week, unix_from_gps, unwrap_week
from kgcp.io.files.safe_read import read_lines
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.files.time_text import is_in_calendar, parse_time
from kgcp.io.formats.frame_names import likely_difference
from kgcp.io.formats.registry import Registry
from kgcp.io.formats.rtklib_pos import looks_like_solution, read_solution
from kgcp.measurement.plate_prior import SceneRotation

_RATES = ("rate_x_deg_s", "rate_y_deg_s", "rate_z_deg_s")
_SD_RATE, _SD_RATE_DEG_S = "sd_rate_deg_s", 1.0

# Number, GPS seconds of the week, [week]; positions and their deviations follow.
_MARK = re.compile(r"(\d{1,9})\s+(\d{1,9}(?:\.\d*)?)\s+\[\s*(\d{1,9})\s*\](?:\s|$)")
_LAST_NUMBER = re.compile(r"(.*?)(\d+)\D*")


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """Content of a times file, by the names of frames.

    Entries that belong to no frame are stored under their names in the file.
    """

    time_s: Mapping[str, float]  # Unix UTC [s]
    # of the scene at that time: the camera's rates about its axes with the opposite sign
    rotation: Mapping[str, SceneRotation] = field(default_factory=dict)


def read_times(path: Path, frames: Sequence[str], times_format: str | None = None) -> FrameTimes:
    """Read the times of frames, in one of the `FORMATS` of docs/foreign_files.md.

    Parameters
    ----------
    frames : sequence of str
        Names of all frames, sorted.
    times_format : str or None
        Name of the format; None: the content tells.

    Raises
    ------
    KgcpError
        If the file is missing or wrong, or its marks cannot be assigned to frames. The message
        names file and line.
    """
    file = ForeignFile(path, "[frames] times")
    times = FORMATS.reader(file, times_format)(file, frames)
    if not all(map(is_in_calendar, times.time_s.values())):
        raise file.error("GPS week out of range", "give the file of this flight")
    return times


def _read_csv(file: ForeignFile, frames: Sequence[str]) -> FrameTimes:
    """Return the columns frame and time; times are mid-exposure, in the notations of `parse_time`.

    There may also be columns of the camera's rates. Frames are named as by
    `kgcp.io.images.frames.list_frames`.
    """
    columns = read_csv_columns(file.path, ("frame", "time"), (), (*_RATES, _SD_RATE), file.toml_key)
    times = {}
    rows = zip(columns.lines, columns.frames(), columns.texts["time"], strict=True)
    for line, frame, text in rows:
        try:
            times[frame] = parse_time(text)
        except SettingError as error:
            raise KgcpError(f"{file.path}, line {line}: {error}") from None
    if frames and not times:
        raise file.error("names no frame", "give a line with name and time for every frame")
    if frames and times.keys().isdisjoint(frames):
        raise _no_common_name(file, [*times], frames)
    return FrameTimes(times, _rotations(columns, times))


def _rotations(columns: CsvColumns, frames: Iterable[str]) -> dict[str, SceneRotation]:
    """Return the rotation of the scene by frame; empty if the file has no rates."""
    if not set(_RATES) & set(columns.names):
        return {}
    missing = [name for name in _RATES if name not in columns.names]
    if missing:
        raise KgcpError(
            f"{columns.path}, line 1: has no {', '.join(missing)}; give the rates about all three"
            " of the camera's axes, or none"
        )
    sds = columns.deviations((_SD_RATE,))
    sd_rad_s = np.radians(np.full(len(columns.lines), _SD_RATE_DEG_S) if sds is None else sds[:, 0])
    rates_rad_s = np.radians(columns.block(_RATES)).tolist()
    return {
        frame: SceneRotation((-x, -y, -z), sd)
        for frame, (x, y, z), sd in zip(frames, rates_rad_s, sd_rad_s.tolist(), strict=True)
    }


def _no_common_name(file: ForeignFile, names: Sequence[str], frames: Sequence[str]) -> KgcpError:
    name, frame, difference = likely_difference(names, frames) or (names[0], frames[0], "")
    explanation = f" ({difference})" if difference else ""
    return file.error(
        f"none of its {len(names)} names is a frame's: it has {name!r}, the frames folder has"
        f" {frame!r}{explanation}",
        "write names as paths below the frames folder, or give the times of these frames",
    )


def looks_like_marks(file: ForeignFile) -> bool:
    """Return whether a file's first line is one of DJI's marks."""
    return _MARK.match(file.head.decode("utf-8-sig", errors="replace").lstrip()) is not None


def _read_marks(file: ForeignFile, frames: Sequence[str]) -> FrameTimes:
    """Return the times of DJI's marks by frame: a mark's number is the last one in a frame's name.

    Marks also have positions of the antenna, and offsets from it to the sensor (north, east and
    **down**, mm). Both are those of the drone, and a vehicle's target needs neither.
    """
    path = file.path
    clocks: dict[int, FloatArray] = {}
    first_lines: dict[int, int] = {}
    for line, row in enumerate(read_lines(path, file.toml_key), start=1):
        if not row.strip():
            continue
        match = _MARK.match(row.strip())
        if match is None:
            raise file.error_at(
                f"line {line}",
                "does not begin with number, GPS seconds and [week]",
                "repair the line",
            )
        number = int(match[1])
        if first_lines.setdefault(number, line) != line:
            raise file.error_at(
                f"line {line}",
                f"number {number} is also in line {first_lines[number]}",
                "give the marks of one flight",
            )
        clocks[number] = clock_from_week(np.array(float(match[3])), np.array(float(match[2])))
    if not clocks:
        raise file.error("holds no marks", "give the Timestamp.MRK of this flight")
    unix_s = unix_from_gps(unwrap_week(np.array([*clocks.values()]))).tolist()
    return _join_by_number(file, dict(zip(clocks, unix_s, strict=True)), frames)


def _join_by_number(
    file: ForeignFile, marks: dict[int, float], frames: Sequence[str]
) -> FrameTimes:
    times = {}
    owners: dict[int, tuple[str, str]] = {}
    for frame in frames:
        match = _LAST_NUMBER.fullmatch(PurePosixPath(frame).stem)
        if match is None or int(match[2]) not in marks:
            continue
        number = int(match[2])
        prefix = str(PurePosixPath(frame).parent / match[1])
        other, other_prefix = owners.setdefault(number, (frame, prefix))
        if prefix != other_prefix:
            raise file.error(
                f"its number {number} may be that of {other!r} or of {frame!r}",
                "give the frames of one flight, or frames.csv",
            )
        times[frame] = marks[number]
    if not times:
        raise file.error(
            f"none of its {len(marks)} numbers is the last number in the name of a frame"
            f" ({frames[0]!r}, …)",
            "give the marks of this flight, or frames.csv",
        )
    unassigned = {str(number): time for number, time in marks.items() if number not in owners}
    return FrameTimes({**unassigned, **times})


def _read_events(file: ForeignFile, frames: Sequence[str]) -> FrameTimes:
    """Return the times of RTKLIB's events by frame, in the same order, as events have no names."""
    solution = read_solution(file)
    if len(solution.time_s) != len(frames):
        raise file.error(
            f"has {len(solution.time_s)} events for {len(frames)} frames, so it is unknown which"
            " belong together (RTKLIB keeps one event per epoch of observations and loses the"
            " others)",
            "add or remove frames that differ, or give frames.csv",
        )
    backwards = np.flatnonzero(np.diff(solution.time_s) <= 0.0)
    if backwards.size:
        where = f"line {solution.lines[int(backwards[0]) + 1]}"
        raise file.error_at(where, "its event is not later than the one before", "sort them")
    return FrameTimes(dict(zip(frames, solution.time_s.tolist(), strict=True)))


FORMATS: Registry[Callable[[ForeignFile, Sequence[str]], FrameTimes]] = Registry(
    "a file of frame times",
    "give a CSV file with the columns frame and time",
    {
        "mrk": (looks_like_marks, _read_marks),
        "rtklib": (looks_like_solution, _read_events),
        "csv": (lambda _: True, _read_csv),  # its reader reports what is wrong with the file
    },
)
