"""Trajectories of NovAtel's Waypoint programs, Inertial Explorer and GrafNav, exported as text.

Roll and pitch are right-handed rotations about the vehicle's axes forward and right, and the
heading is clockwise from true north, in the order heading, pitch, roll (NovAtel APN-037, "Vehicle
to body rotations"): these are the angles of docs/conventions.md.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import WGS84_3D
from kgcp.io.files.gps_time import (
    TimeSystem,
    clock_from_date,
    clock_from_week,
    midnight_s,
    unix_from_clock,
    unwrap_week,
)
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories.records import (
    Epochs,
    TrajectoryFileOptions,
    check_times,
    valid_covariances,
)
from kgcp.io.formats.trajectories.times import times_from_week
from kgcp.io.formats.waypoint_export import WaypointExport, read_export

PLACE = ("Longitude", "Latitude", "H-Ell")
_SD_PLACE = ("SDEast", "SDNorth", "SDHeight")
_COV_PLACE = (("CxEE", "CxEN", "CxEH"), ("CxEN", "CxNN", "CxNH"), ("CxEH", "CxNH", "CxHH"))
_ATTITUDE = ("Roll", "Pitch", "Heading")
_SD_ATTITUDE = (("RollSD", "PitchSD", "HdngSD"), ("RollSD", "PtchSD", "HdngSD"))
_WEEK, _WEEK_UNIT = "Week", "weeks"
# Columns of times, by preference: with the days in a column of dates, and the time system
_TIMES = (
    ("GPSTime", ("GPSDate", "Date"), TimeSystem.GPS),
    ("CorrTime", ("GPSDate", "Date"), TimeSystem.GPS),
    ("UTCTime", ("UTCDate",), TimeSystem.UTC),
)
_SECONDS, _CLOCK = "sec", "hms"
_DATE_ORDERS = ("mdy", "dmy", "ymd")
_HMS = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2}(?:\.\d*)?)")
_DAY_S = 86400.0
_GPS_YEAR = 1980  # in which it began; years of two digits are earlier
_TIME_REMEDY = "export Week and GPSTime in seconds of the week"


def read(file: ForeignFile, options: TrajectoryFileOptions, _flight_crs: str) -> Epochs:
    """Read longitude, latitude and ellipsoidal height, with attitude and deviations if given."""
    export = read_export(file)
    time_s = _times(export, options)
    check_times(file.path, time_s, lambda row: f"line {export.lines[row]}")
    missing = [name for name in PLACE if name not in export.columns]
    if missing:
        raise file.error(f"lacks {', '.join(missing)}", f"export {', '.join(PLACE)}")
    if options.crs is None:
        _check_datum(export)
    cov, sd_position_m = _position_precision(export)
    sd_attitude_deg = None
    for names in _SD_ATTITUDE:
        if set(names) <= export.columns.keys():
            sd_attitude_deg = _deviations(export, names, "deg", "Attitude")
    with_attitude = has_attitude(export)
    return Epochs(
        time_s=time_s,
        crs=options.crs or WGS84_3D,
        position=np.column_stack((_block(export, PLACE[:2], "deg"), export.numbers(PLACE[2], "m"))),
        attitude_deg=_block(export, _ATTITUDE, "deg") if with_attitude else None,
        sd_position_m=sd_position_m,
        cov_position_m2=cov,
        sd_attitude_deg=sd_attitude_deg if with_attitude else None,
    )


def has_attitude(export: WaypointExport) -> bool:
    """Return whether an export has roll, pitch and heading."""
    return set(_ATTITUDE) <= export.columns.keys()


@dataclass(frozen=True, slots=True)
class TimeColumns:
    """The columns that say when the epochs are."""

    time: str
    date: str | None  # of days; None: there is none
    has_weeks: bool  # whether there is a column of GPS weeks
    system: TimeSystem

    @property
    def has_days(self) -> bool:
        """Whether the file says on which day an epoch is."""
        return self.date is not None or self.has_weeks


def _times(export: WaypointExport, options: TrajectoryFileOptions) -> FloatArray:
    """Return the Unix times (n,) of the epochs."""
    file, columns = export.file, time_columns(export)
    if options.time_system not in (None, columns.system):
        raise file.error(
            f"has {columns.system.value.upper()} times in its column {columns.time}, but [vehicle]"
            f" time_system is {options.time_system}",
            "delete time_system from flight.toml",
        )
    if columns.has_days and options.first_day is not None:
        raise file.error("says on which days its epochs are", "delete date from flight.toml")
    if columns.date is not None and export.columns[columns.time].unit.lower() == _CLOCK:
        clock_s = _dates_s(export, columns.date) + _clock_s(export, columns.time)
        return unix_from_clock(clock_s, columns.system)
    seconds = export.numbers(columns.time, _SECONDS)
    if columns.has_weeks:
        clock_s = clock_from_week(export.numbers(_WEEK, _WEEK_UNIT), seconds)
        return unix_from_clock(unwrap_week(clock_s), columns.system)
    if columns.date is None:
        dated = replace(options, time_system=columns.system)
        return times_from_week(file.path, seconds, dated)
    if not len(seconds) or seconds.max() < _DAY_S:
        return unix_from_clock(_dates_s(export, columns.date) + seconds, columns.system)
    # seconds of the week: where a new one begins, dates are not reliable
    of_week = clock_from_date(_date(export, columns.date, 0), seconds)
    if of_week is None:
        raise export.error_at(0, f"{columns.time} is not on the day of {columns.date}")
    return unix_from_clock(of_week, columns.system)


def time_columns(export: WaypointExport) -> TimeColumns:
    """Return the columns that say when the epochs are.

    Raises
    ------
    KgcpError
        If there are none.
    """
    for time, dates, system in _TIMES:
        if time not in export.columns:
            continue
        day = next((name for name in dates if name in export.columns), None)
        has_weeks = system is TimeSystem.GPS and _WEEK in export.columns
        if day is not None or export.columns[time].unit.lower() != _CLOCK:
            return TimeColumns(time, day, has_weeks, system)
    raise export.file.error("has no column of times with their day or week", _TIME_REMEDY)


def _dates_s(export: WaypointExport, days: str) -> FloatArray:
    """Return the beginnings of days (n,) as clock times [s]."""
    texts = export.columns[days].texts
    _, rows, day = np.unique(texts, return_index=True, return_inverse=True)
    return np.array([midnight_s(_date(export, days, row)) for row in rows.tolist()])[day]


def _date(export: WaypointExport, days: str, row: int) -> date:
    column = export.columns[days]
    order, text = column.unit.lower(), column.texts[row]
    if order not in _DATE_ORDERS:
        raise export.file.error(f"has dates in {column.unit or 'no unit'}", _TIME_REMEDY)
    try:
        parts = dict(zip(order, map(int, re.split("[-/.]", text)), strict=True))
        day = date(parts["y"], parts["m"], parts["d"])
    except (ValueError, OverflowError):
        day = date.min
    if day.year < _GPS_YEAR:
        raise export.error_at(row, f"{days} {text!r} is not a date of GPS", _TIME_REMEDY)
    return day


def _clock_s(export: WaypointExport, time: str) -> FloatArray:
    """Return seconds (n,) since midnight of times hh:mm:ss."""
    values = np.empty(len(export.lines))
    for row, text in enumerate(export.columns[time].texts):
        match = _HMS.fullmatch(text)
        if match is None:
            raise export.error_at(row, f"{time} {text!r} is not hh:mm:ss", _TIME_REMEDY)
        values[row] = 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3])
    return values


def _check_datum(export: WaypointExport) -> None:
    """Refuse positions that are not known to be WGS 84 by a base station's datum."""
    datum, source = export.header.get("Datum", "unknown"), export.header.get("Source", "")
    if "PPP" in source:
        raise export.file.error(
            "was computed by precise point positioning, so that its coordinates are in ITRF",
            'name its CRS under [vehicle] in flight.toml: crs = "EPSG:9989" is ITRF2020',
        )
    if not re.match(r"WGS[ -]?84\b(?!\s*\()", datum):
        raise export.file.error(
            f"its header gives the datum as {datum}",
            "name its CRS under [vehicle] crs in flight.toml, or export WGS84",
        )


def _position_precision(export: WaypointExport) -> tuple[FloatArray | None, FloatArray | None]:
    """Return covariances (n, 3, 3) [m²] and deviations (n, 3) [m]; None: not in the file."""
    cells = {name for row in _COV_PLACE for name in row}
    if cells <= export.columns.keys():
        _check_scale(export, "Position")
        written = np.stack([_block(export, row, "m^2") for row in _COV_PLACE], axis=1)
        cov = valid_covariances(written)
        return cov, np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    if not set(_SD_PLACE) <= export.columns.keys():
        return None, None
    return None, _deviations(export, _SD_PLACE, "m", "Position")


def _deviations(export: WaypointExport, names: Sequence[str], unit: str, kind: str) -> FloatArray:
    _check_scale(export, kind)
    deviations = _block(export, names, unit)
    if deviations.size and deviations.min() < 0.0:
        row = int(np.argmin(deviations.min(axis=1)))
        raise export.error_at(row, "a standard deviation is negative")
    return deviations


def _check_scale(export: WaypointExport, kind: str) -> None:
    """Refuse standard deviations that the program has scaled to a higher confidence."""
    scale = export.scales.get(kind, "1")
    number = re.match(r"\d+(?:\.\d*)?", scale)
    if scale.lower().startswith("no scaling") or (number and float(number[0]) == 1.0):
        return
    raise export.file.error(
        f"has scaled its standard deviations ({kind}: {scale})",
        "export them without scaling, as one standard deviation",
    )


def _block(export: WaypointExport, names: Sequence[str], unit: str) -> FloatArray:
    return np.column_stack([export.numbers(name, unit) for name in names])
