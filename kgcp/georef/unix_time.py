"""Unix seconds as dates, on every system and for any year."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def date_of(unix_s: float) -> datetime:
    """Return Unix seconds as a UTC date, rounded to the microsecond.

    `datetime.fromtimestamp` refuses times before 1970 on Windows. Frames have such times if these
    count from the start of the flight.
    """
    return EPOCH + timedelta(microseconds=round(unix_s * 1e6))
