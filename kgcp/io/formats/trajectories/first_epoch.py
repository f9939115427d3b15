"""Place and time of a trajectory's beginning, without the keys of flight.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.georef.crs import WGS84_3D, wgs84_from_map
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.rtklib_pos import read_solution
from kgcp.io.formats.trajectories.foreign_csv import ForeignTable
from kgcp.io.formats.trajectories.rtklib import GEOCENTRIC
from kgcp.io.formats.trajectories.sbet import first_record
from kgcp.io.formats.trajectories.waypoint import PLACE, has_attitude, time_columns
from kgcp.io.formats.waypoint_export import read_export

_GEODETIC, _ECEF = ("longitude", "latitude"), ("x-ecef", "y-ecef", "z-ecef")


@dataclass(frozen=True, slots=True)
class TrajectoryFile:
    """A file with a trajectory, in one of the formats of docs/foreign_files.md."""

    path: Path
    format: str
    table: ForeignTable | None = None  # of a CSV file


@dataclass(frozen=True, slots=True)
class FirstEpoch:
    """The beginning of a trajectory."""

    x: float
    y: float
    crs: str | None  # of x, y, for pyproj; None: the file does not say
    time: str  # as in the file; empty if the format defines day and time system
    has_attitude: bool


def first_epoch(file: TrajectoryFile) -> FirstEpoch | None:
    """Return the first epoch of a trajectory; None if the file cannot be read."""
    try:
        if file.format == "sbet":
            return _of_sbet(file.path)
        if file.format == "rtklib":
            return _of_solution(file.path)
        if file.format == "waypoint":
            return _of_waypoint(file.path)
        if file.table is not None:
            return _of_table(file.table)
        words = ForeignFile(file.path, "").first_line.split()
        return FirstEpoch(float(words[1]), float(words[2]), None, words[0], has_attitude=True)
    except (KgcpError, LookupError, ValueError):
        return None


def _of_sbet(path: Path) -> FirstEpoch:
    seconds, latitude, longitude = first_record(path)[:3].tolist()
    longitude, latitude = np.degrees((longitude, latitude)).tolist()
    return FirstEpoch(longitude, latitude, WGS84_3D, repr(seconds), has_attitude=True)


def _of_solution(path: Path) -> FirstEpoch:
    columns = read_solution(ForeignFile(path, "[vehicle] trajectory")).columns
    if _GEODETIC[0] in columns:
        longitude, latitude = (float(columns[name][0]) for name in _GEODETIC)
    else:
        place = np.array([columns[name][0] for name in _ECEF])
        longitude, latitude = wgs84_from_map(GEOCENTRIC, [place], path.name)[0, :2].tolist()
    return FirstEpoch(longitude, latitude, WGS84_3D, "", has_attitude=False)


def _of_waypoint(path: Path) -> FirstEpoch:
    export = read_export(ForeignFile(path, "[vehicle] trajectory"))
    longitude, latitude = (float(export.numbers(name, "deg")[0]) for name in PLACE[:2])
    columns = time_columns(export)
    time = "" if columns.has_days else export.columns[columns.time].texts[0]
    return FirstEpoch(longitude, latitude, WGS84_3D, time, has_attitude=has_attitude(export))


def _of_table(foreign: ForeignTable) -> FirstEpoch | None:
    x, y = foreign.table.number("x"), foreign.table.number("y")
    if x is None or y is None:
        return None
    crs = WGS84_3D if foreign.is_geographic else None
    time = foreign.table.cells["time"].replace(foreign.table.layout.decimal, ".")
    return FirstEpoch(x, y, crs, time, foreign.has_attitude)
