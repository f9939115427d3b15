from __future__ import annotations

from datetime import UTC, date, datetime
from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import KgcpWarning
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.gps_time import (
    _LEAPS_UTC_S,
    LEAPS_KNOWN_UNTIL,
    WEEK_S,
    TimeSystem,
    clock_from_date,
    clock_from_week,
    unix_from_clock,
    unix_from_gps,
    unwrap_week,
    weekday,
)


def gps_from_unix(unix_s: FloatArray) -> FloatArray:
    return unix_s + np.searchsorted(_LEAPS_UTC_S, unix_s, side="right")


def utc(year: int, month: int, day: int, hour: int = 0, minute: int = 0, second: int = 0) -> float:
    return datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("moment", "ahead_s"),
    [
        (utc(1980, 1, 6), 0),
        (utc(1981, 6, 30, 23, 59, 59), 0),
        (utc(1981, 7, 1), 1),
        (utc(2006, 1, 1), 14),
        (utc(2012, 6, 30), 15),
        (utc(2015, 6, 30, 12), 16),  # formats: 16 s since July 2012, 17 s since July 2015,
        (utc(2015, 7, 1), 17),
        (utc(2016, 12, 31, 23, 59, 59), 17),
        (utc(2017, 1, 1), 18),  # 18 s since 2017
        (utc(2026, 6, 16, 8, 15), 18),
    ],
)
def test_gps_is_ahead_of_utc_by_the_leap_seconds_so_far(moment: float, ahead_s: int) -> None:
    clock = gps_from_unix(np.array(moment))
    assert clock - moment == ahead_s
    assert unix_from_gps(clock) == moment


def test_weeks_and_seconds_as_other_programs_count_them() -> None:
    # 2026-05-04T09:30:00Z is a Monday: 2417 weeks after 1980-01-06 began Sunday 2026-05-03.
    clock = clock_from_week(np.array(2417), np.array(86400.0 + 9.5 * 3600.0 + 18.0))
    assert unix_from_gps(clock) == utc(2026, 5, 4, 9, 30)
    # The line of the Timestamp.MRK of 2023 that formats are explained with: Thursday 2023-06-01
    clock = clock_from_week(np.array(2264), np.array(400373.488877))
    moment = datetime.fromtimestamp(float(unix_from_gps(clock)), UTC)
    assert moment.strftime("%Y-%m-%d %H:%M:%S.%f")[:-1] == "2023-06-01 15:12:35.48887"


def test_within_a_leap_second_unix_time_repeats() -> None:
    before = gps_from_unix(np.array(utc(2016, 12, 31, 23, 59, 59)))
    clock = before + np.array([0.0, 0.5, 1.0, 1.5, 2.0])  # 59, 59.5, 60, 60.5, 00
    midnight = utc(2017, 1, 1)
    expected = midnight + np.array([-1.0, -0.5, 0.0, 0.5, 0.0])
    np.testing.assert_array_equal(unix_from_gps(clock), expected)


def test_after_its_expiry_the_table_says_so() -> None:
    expiry = utc(LEAPS_KNOWN_UNTIL.year, LEAPS_KNOWN_UNTIL.month, LEAPS_KNOWN_UNTIL.day)
    assert unix_from_gps(np.array(expiry + 17.0)) == expiry - 1.0
    with pytest.warns(KgcpWarning, match="18 s ahead of UTC, which is known until"):
        assert unix_from_gps(np.array(expiry + 18.0)) == expiry
    assert unix_from_clock(np.array(expiry), TimeSystem.UTC) == expiry  # UTC needs no table


def test_the_table_is_that_of_the_time_zone_database() -> None:
    pytest.importorskip("tzdata")
    text = resources.files("tzdata").joinpath("zoneinfo", "leapseconds").read_text()
    (expires,) = [line for line in text.splitlines() if line.startswith("#expires")]
    if float(expires.split()[1]) < utc(2026, 12, 28):
        pytest.skip("an old time zone database")
    midnights = []
    for line in text.splitlines():
        if line.startswith("Leap"):
            _, year, month, day, clock, sign, _ = line.split()
            assert (clock, sign) == ("23:59:60", "+")
            last_day = datetime.strptime(f"{year} {month} {day}", "%Y %b %d").replace(tzinfo=UTC)
            midnights.append(last_day.timestamp() + 86400.0)
    since_gps = [midnight for midnight in midnights if midnight > utc(1980, 1, 6)]
    for count, midnight in enumerate(since_gps, start=1):
        before_and_after = midnight + np.array([-1.0, 0.0])
        ahead = gps_from_unix(before_and_after) - before_and_after
        assert ahead.tolist() == [count - 1, count]
    assert len(since_gps) == 18


@given(st.floats(utc(1980, 1, 7), utc(2027, 6, 1)))
def test_there_and_back(unix_s: float) -> None:
    assert unix_from_gps(gps_from_unix(np.array(unix_s))) == pytest.approx(unix_s, abs=1e-6)


def test_seconds_of_the_week_count_on_over_saturday_midnight() -> None:
    seconds = np.array([604799.0, 604799.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(
        unwrap_week(seconds), [604799.0, 604799.5, WEEK_S, WEEK_S + 0.5, WEEK_S + 1.0]
    )
    clock = clock_from_date(date(2026, 5, 9), seconds)  # the Saturday
    assert clock is not None
    np.testing.assert_array_equal(clock, utc(2026, 5, 10) + np.array([-1.0, -0.5, 0.0, 0.5, 1.0]))
    assert clock_from_date(date(2026, 5, 10), seconds) is None  # it began on Saturday


def test_seconds_may_count_on_beyond_the_week_by_themselves() -> None:
    clock = clock_from_date(date(2026, 5, 9), np.array([604799.0, 604800.0]))
    assert clock is not None
    np.testing.assert_array_equal(clock, utc(2026, 5, 10) + np.array([-1.0, 0.0]))
    clock = clock_from_date(date(2026, 5, 10), np.array([604801.0, 604802.0]))
    assert clock is not None
    np.testing.assert_array_equal(clock, utc(2026, 5, 10) + np.array([1.0, 2.0]))


@given(day=st.dates(date(1990, 1, 1), date(2040, 1, 1)), second=st.floats(0.0, 86399.0))
def test_a_date_finds_its_week(day: date, second: float) -> None:
    sunday_first = (day.weekday() + 1) % 7
    clock = clock_from_date(day, np.array([86400.0 * sunday_first + second]))
    assert clock is not None
    assert clock[0] == pytest.approx(utc(day.year, day.month, day.day) + second, abs=1e-6)


def test_days_of_the_week_begin_on_sunday() -> None:
    assert [weekday(day * 86400.0 + 5.0) for day in (0, 1, 6, 7)] == [
        *("Sunday", "Monday", "Saturday", "Sunday")
    ]
