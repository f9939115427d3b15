"""Rows of tables before they are in one; workers make them, who need not load Arrow for it."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

Row = Mapping[str, object]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def time_cell(time_s: float | None) -> datetime | None:
    """Return Unix seconds as a table cell: UTC, rounded to the microsecond."""
    return None if time_s is None else _EPOCH + timedelta(microseconds=round(time_s * 1e6))
