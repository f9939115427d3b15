"""Dates of any second, where the system refuses those before 1970."""

from __future__ import annotations

from datetime import UTC, datetime, tzinfo
from typing import Self

import numpy as np
import pytest

from kgcp.georef.gps_counts import gps_count_remedy
from kgcp.georef.unix_time import date_of
from kgcp.quality.checks.clock import time_span


class WindowsDatetime(datetime):
    """Dates as Windows makes them of Unix seconds."""

    @classmethod
    def fromtimestamp(cls, timestamp: float, tz: tzinfo | None = None) -> Self:
        if not 0.0 <= timestamp < 32_536_850_400.0:
            raise OSError(22, "Invalid argument")
        return super().fromtimestamp(timestamp, tz)


def test_times_counted_from_the_start_of_a_flight_are_converted_to_dates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in ("georef.gps_counts", "georef.unix_time", "quality.checks.clock"):
        monkeypatch.setattr(f"kgcp.{module}.datetime", WindowsDatetime, raising=False)
    assert time_span(np.array([-2.0, 600.0])) == "1969-12-31 23:59:58 to 1970-01-01 00:10:00"
    assert date_of(-0.25) == datetime(1969, 12, 31, 23, 59, 59, 750_000, tzinfo=UTC)
    remedy = gps_count_remedy(60_000_000_000.0, 7.0)
    assert remedy is not None
    assert "date = 3871-04-29," in remedy
