"""Times as text: UTC in ISO 8601, or Unix seconds."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from kgcp.errors import SettingError
from kgcp.georef.unix_time import EPOCH, date_of

_SECOND = timedelta(seconds=1)
_EARLIEST_S = datetime(1, 1, 3, tzinfo=UTC).timestamp()
_LATEST_S = datetime(9999, 12, 29, tzinfo=UTC).timestamp()
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
"""A decimal number, written out: neither nan nor inf, no underscores."""
_GPS_WEEK = re.compile(r"\d{4}[\s:;/]+\d{1,6}(\.\d*)?")
_DAY = re.compile(r"\d{1,4}([-./])\d{1,2}\1\d{1,4}")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d*)?)?Z?")
_JOIN = "join date and time in one column, as 2026-05-04T09:30:05.25Z, or give Unix seconds"
_REMEDY = "give UTC as 2026-05-04T09:30:05.25Z or as Unix seconds"


def parse_time(text: str) -> float:
    """Read a time as Unix seconds (UTC).

    Parameters
    ----------
    text : str
        ISO 8601 with `Z` or an offset, or Unix seconds. Times without a time zone are
        rejected: UTC is never assumed.

    Returns
    -------
    float
        Seconds since 1970-01-01T00:00:00Z, resolved to 0.25 µs in our century.

    Raises
    ------
    SettingError
        For anything else, with the text that was found.
    """
    text = text.strip()
    if NUMBER.fullmatch(text):
        return _in_calendar(float(text), f"{text} is out of range as Unix seconds")
    if _GPS_WEEK.fullmatch(text):
        raise SettingError(
            "time",
            f"{text!r} is a GPS week with seconds",
            f"{_REMEDY}; a trajectory may have the seconds alone, with [vehicle] date and"
            " time_system",
        )
    half = half_of_time(text)
    if half is not None:
        raise SettingError("time", f"{text!r} is {half}", _JOIN)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise SettingError("time", f"{text!r} is not a time", _REMEDY) from None
    if moment.tzinfo is None:
        raise SettingError("time", f"{text!r} names no time zone", _REMEDY)
    return _in_calendar((moment - EPOCH) / _SECOND, f"{text!r} is out of range")


def half_of_time(text: str) -> str | None:
    """Tell in words which half of a time is missing; None: neither, or it is no time at all."""
    if _DAY.fullmatch(text):
        return "a date without a time of day"
    return "a time of day without a date" if _CLOCK.fullmatch(text) else None


def names_zone(text: str) -> bool | None:
    """Tell whether date and time in ISO 8601 have a time zone; None: the text is something else."""
    if NUMBER.fullmatch(text) or half_of_time(text) is not None:
        return None
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return None


def format_time(unix_s: float) -> str:
    """Write Unix seconds as ISO 8601 in UTC with microseconds and `Z`."""
    return date_of(unix_s).isoformat(timespec="microseconds").replace("+00:00", "Z")


def is_in_calendar(unix_s: float) -> bool:
    """Return whether Unix seconds are a date, and will be if a day is added or taken off."""
    return _EARLIEST_S <= unix_s <= _LATEST_S


def _in_calendar(unix_s: float, problem: str) -> float:
    """Refuse seconds that no calendar date has: milliseconds, mostly."""
    if not is_in_calendar(unix_s):
        raise SettingError("time", problem, _REMEDY)
    return unix_s
