"""GPS time: weeks and seconds, and how far it is ahead of UTC.

GPS time counts on without leap seconds since 1980-01-06. Here a *clock time* is what a clock of
some time system shows, counted as Unix seconds count UTC: the seconds since that clock showed
1970-01-01 00:00. The clock time of UTC is Unix time itself.
"""

from __future__ import annotations

import calendar
import warnings
from datetime import UTC, date, datetime
from enum import StrEnum

import numpy as np

from kgcp.errors import KgcpWarning
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.unix_time import date_of

WEEK_S = 604800.0
_DAY_S = 86400.0
_GPS_START_S = datetime(1980, 1, 6, tzinfo=UTC).timestamp()  # a Sunday

# First days on which GPS time was 1, 2, … seconds ahead of UTC: IERS Bulletin C, TAI − UTC − 19 s.
_LEAPS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01"),
    *("1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01"),
    *("1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
LEAPS_KNOWN_UNTIL = date(2027, 6, 28)  # as leap-seconds.list after Bulletin C 72 says it expires


class TimeSystem(StrEnum):
    """Whose clock a file's times are of."""

    GPS = "gps"
    UTC = "utc"


def midnight_s(day: date) -> float:
    """Return the clock time at which a day begins [s]."""
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


_LEAPS_UTC_S: FloatArray = np.array([midnight_s(date.fromisoformat(day)) for day in _LEAPS])
_LEAPS_GPS_S: FloatArray = _LEAPS_UTC_S + np.arange(1, len(_LEAPS) + 1)


def unix_from_gps(clock_s: FloatArray) -> FloatArray:
    """Return Unix times (UTC) of GPS clock times, of any shape [s].

    Within a leap second (23:59:60) Unix time repeats the next second. Times after
    `LEAPS_KNOWN_UNTIL` are taken as if no leap second had come since, with a `KgcpWarning`.
    """
    clock_s = np.asarray(clock_s, dtype=np.float64)
    unix_s: FloatArray = clock_s - np.searchsorted(_LEAPS_GPS_S, clock_s, side="right")
    if unix_s.size and unix_s.max() >= midnight_s(LEAPS_KNOWN_UNTIL):
        warnings.warn(
            f"GPS time is taken as {len(_LEAPS)} s ahead of UTC, which is known until"
            f" {LEAPS_KNOWN_UNTIL} only; use a newer version of kgcp if there was a leap second",
            KgcpWarning,
            stacklevel=2,
        )
    return unix_s


def unix_from_clock(clock_s: FloatArray, system: TimeSystem) -> FloatArray:
    """Return Unix times (UTC) of the clock times of a time system [s]."""
    return unix_from_gps(clock_s) if system is TimeSystem.GPS else np.asarray(clock_s, float)


def clock_from_week(week: FloatArray, seconds: FloatArray) -> FloatArray:
    """Return clock times of GPS weeks (counted on beyond 1023) and seconds of the week."""
    clock_s: FloatArray = np.asarray(week, float) * WEEK_S + seconds + _GPS_START_S
    return clock_s


def unwrap_week(seconds: FloatArray) -> FloatArray:
    """Let seconds (n,) of the week count on where they jump back by a week."""
    jumps = np.diff(seconds, prepend=seconds[:1]) < -0.5 * WEEK_S
    counted: FloatArray = seconds + WEEK_S * np.cumsum(jumps)
    return counted


def clock_from_date(first_day: date, seconds: FloatArray) -> FloatArray | None:
    """Return clock times of seconds (n,) of the week, n ≥ 1, the first of which is on a given day.

    None if the first is on another day of the week than the date.
    """
    seconds = unwrap_week(np.asarray(seconds, dtype=np.float64))
    within = seconds[0] % WEEK_S
    midnight = midnight_s(first_day)
    since_midnight = within - (midnight - _GPS_START_S) % WEEK_S
    if not 0.0 <= since_midnight < _DAY_S:
        return None
    clock_s: FloatArray = midnight + since_midnight + (seconds - seconds[0])
    return clock_s


def first_day_near(seconds: float, unix_s: float, system: TimeSystem) -> date:
    """Return the day of seconds of the week, by their own clock, in the week nearest to a time.

    Parameters
    ----------
    unix_s : float
        Shortly after those seconds, or before: by less than half a week [s].
    """
    clock_s = unix_s
    if system is TimeSystem.GPS:
        clock_s += unix_s - float(unix_from_gps(np.array(unix_s)))
    within = seconds % WEEK_S
    weeks = round((clock_s - _GPS_START_S - within) / WEEK_S)
    return date_of(_GPS_START_S + weeks * WEEK_S + within).date()


def weekday(seconds: float) -> str:
    """Name the day of seconds of the week."""
    return calendar.day_name[(calendar.SUNDAY + int(seconds // _DAY_S)) % 7]
