"""Unix seconds as dates of any year, on every system."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def date_of(unix_s: float) -> datetime:
    """Return Unix seconds as a UTC date, rounded to the microsecond.

    `datetime.fromtimestamp` refuses seconds before 1970 on Windows, as frames have them whose times
    count from the start of a flight.
    """
    return EPOCH + timedelta(microseconds=round(unix_s * 1e6))
