"""Times of trajectories by the keys of [vehicle]."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.gps_time import TimeSystem, clock_from_date, unix_from_clock, weekday
from kgcp.io.files.time_text import NUMBER, names_zone, parse_time
from kgcp.io.formats.trajectories.records import TrajectoryFileOptions


def times_from_texts(
    path: Path, lines: Sequence[int], texts: Sequence[str], options: TrajectoryFileOptions
) -> FloatArray:
    """Return the Unix times (n,) of texts by docs/foreign_files.md, "Trajectories and times".

    Raises
    ------
    KgcpError
        If a text is no time, has no zone, or has a zone that contradicts `time_system`. The message
        names the line.
    """
    if options.first_day is not None:
        return times_from_week(path, _numbers(path, lines, texts), options)
    clock_s = np.array(
        [
            _clock_time(text, options.time_system, f"{path}, line {line}")
            for line, text in zip(lines, texts, strict=True)
        ]
    )
    return unix_from_clock(clock_s, options.time_system or TimeSystem.UTC)


def times_from_week(path: Path, seconds: FloatArray, options: TrajectoryFileOptions) -> FloatArray:
    """Return the Unix times of seconds (n,) of the week that flight.toml gives.

    Raises
    ------
    KgcpError
        If flight.toml does not give day and time system, or the day is not that of the first epoch.
    """
    day, system = options.first_day, options.time_system
    if day is None or system is None:
        missing = [key for key, value in (("date", day), ("time_system", system)) if value is None]
        raise KgcpError(
            f"{path}: its times are seconds of a week; give {' and '.join(missing)} under"
            " [vehicle] in flight.toml: date = 2026-05-04, the day of the first epoch, and"
            ' time_system = "gps" or "utc"'
        )
    if not seconds.size:
        return seconds
    clock_s = clock_from_date(day, seconds)
    if clock_s is None:
        raise KgcpError(
            f"{path}: its first epoch, second {seconds[0]:g} of the week, is on a"
            f" {weekday(float(seconds[0]))}, but {day} is a {day:%A}; correct [vehicle] date in"
            " flight.toml"
        )
    return unix_from_clock(clock_s, system)


def _numbers(path: Path, lines: Sequence[int], texts: Sequence[str]) -> FloatArray:
    for line, text in zip(lines, texts, strict=True):
        if not NUMBER.fullmatch(text):
            raise KgcpError(
                f"{path}, line {line}: time {text!r} is not seconds of the week, as [vehicle] date"
                " says; delete date from flight.toml, or write seconds"
            )
    return np.array([float(text) for text in texts])


def _clock_time(text: str, system: TimeSystem | None, where: str) -> float:
    has_zone = names_zone(text)
    if has_zone and system is TimeSystem.GPS:
        raise KgcpError(
            f"{where}: time {text!r} names a zone, but [vehicle] time_system is gps;"
            " delete the zone, or time_system from flight.toml"
        )
    if has_zone is False and system is not None:
        text = f"{text}Z"
    try:
        return parse_time(text)
    except SettingError as error:
        raise KgcpError(f"{where}: {error}") from error
