"""Readers of the target carrier's trajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.trajectory import Trajectory
from kgcp.io.csvcolumns import CsvColumns, read_csv_columns
from kgcp.io.times import parse_time

_POSITION = ("x", "y", "z")
_ATTITUDE = ("roll_deg", "pitch_deg", "heading_deg")
_SD_POSITION = tuple(f"sd_{name}" for name in _POSITION)
_SD_ATTITUDE = tuple(f"sd_{name}" for name in _ATTITUDE)


def read_trajectory(path: Path) -> Trajectory:
    """Read the vehicle's trajectory from a CSV file by docs/conventions.md.

    Columns time, x, y, z, roll_deg, pitch_deg, heading_deg and, optionally, sd_x … sd_heading_deg,
    in any order.

    Raises
    ------
    KgcpError
        Naming the line: missing file or columns, values that are not finite, times that do not
        ascend.
    """
    columns = read_csv_columns(
        path,
        "time",
        (*_POSITION, *_ATTITUDE),
        (*_SD_POSITION, *_SD_ATTITUDE),
        "[vehicle] trajectory",
    )
    if len(columns.keys) < 2:
        raise KgcpError(f"{path}: has {len(columns.keys)} epochs; interpolation needs at least two")
    return Trajectory(
        time_s=_ascending_times(columns),
        position_map=columns.block(_POSITION),
        attitude_deg=columns.block(_ATTITUDE),
        sd_position_m=columns.deviations(_SD_POSITION),
        sd_attitude_deg=columns.deviations(_SD_ATTITUDE),
    )


def _ascending_times(columns: CsvColumns) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    times = np.array(
        [_time(columns, line, text) for line, text in zip(columns.lines, columns.keys, strict=True)]
    )
    wrong = np.flatnonzero(np.diff(times) <= 0.0)
    if wrong.size:
        row = int(wrong[0]) + 1
        how = "repeats" if times[row] == times[row - 1] else "lies before"
        raise KgcpError(
            f"{columns.path}, line {columns.lines[row]}: time {columns.keys[row]} {how} that of"
            f" line {columns.lines[row - 1]} ({columns.keys[row - 1]});"
            " sort the epochs and keep one of each"
        )
    return times


def _time(columns: CsvColumns, line: int, text: str) -> float:
    try:
        return parse_time(text)
    except SettingError as error:
        raise KgcpError(f"{columns.path}, line {line}: {error}") from error
