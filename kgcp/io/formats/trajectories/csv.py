"""The project's own trajectories: CSV with named columns."""

from __future__ import annotations

from kgcp.io.files.csv_columns import read_csv_columns
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions, check_times
from kgcp.io.formats.trajectories.times import times_from_texts

_POSITION = ("x", "y", "z")
_ATTITUDE = ("roll_deg", "pitch_deg", "heading_deg")
_SD_POSITION = tuple(f"sd_{name}" for name in _POSITION)
_SD_ATTITUDE = tuple(f"sd_{name}" for name in _ATTITUDE)

COLUMNS = ("time", *_POSITION, *_ATTITUDE, *_SD_POSITION, *_SD_ATTITUDE)
"""Names of all columns in docs/foreign_files.md."""


def matches(file: ForeignFile) -> bool:
    """Whether the first line has several cells."""
    return "," in file.first_line


def read(file: ForeignFile, options: TrajectoryFileOptions, flight_crs: str) -> Epochs:
    """Read a trajectory from a CSV file by docs/foreign_files.md.

    Columns time, x, y, z, roll_deg, pitch_deg, heading_deg and, optionally, sd_x … sd_heading_deg,
    in any order, or with the names in `options.layout`. The attitude may be missing if the course
    replaces it.
    """
    with_attitude = options.course_sd_deg is None
    columns = read_csv_columns(
        file.path,
        ("time",),
        (*_POSITION, *_ATTITUDE) if with_attitude else _POSITION,
        (*_SD_POSITION, *_SD_ATTITUDE),
        file.toml_key,
        options.layout,
    )
    times = [text.replace(options.layout.decimal, ".") for text in columns.texts["time"]]
    time_s = times_from_texts(file.path, columns.lines, times, options)
    check_times(file.path, time_s, lambda row: f"line {columns.lines[row]} ({times[row]})")
    return Epochs(
        time_s=time_s,
        crs=options.crs or flight_crs,
        position=columns.block(_POSITION),
        attitude_deg=columns.block(_ATTITUDE) if with_attitude else None,
        sd_position_m=columns.deviations(_SD_POSITION),
        sd_attitude_deg=columns.deviations(_SD_ATTITUDE) if with_attitude else None,
    )
