from __future__ import annotations

from datetime import datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import KgcpError
from kgcp.io.files.time_text import format_time, parse_time

# 2026-05-04 is day 20577 since 1970-01-01 (56 years of 365 days, 14 leap days, 31+28+31+30+3).
MORNING = (56 * 365 + 14 + 31 + 28 + 31 + 30 + 3) * 86400.0 + 9.5 * 3600.0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1970-01-01T00:00:00Z", 0.0),
        ("2026-05-04T09:30:05.250000Z", MORNING + 5.25),
        ("2026-05-04T11:30:05.25+02:00", MORNING + 5.25),
        ("2026-05-04 09:30:05.25Z", MORNING + 5.25),
        (" 1777887005.25 ", 1777887005.25),
        ("-0.5", -0.5),
        ("1.5e9", 1.5e9),
    ],
)
def test_both_notations_are_read(text: str, expected: float) -> None:
    assert parse_time(text) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2026-05-04T09:30:05", "no time zone"),
        ("2026-05-04", "a date without a time of day; join date and time in one column"),
        ("04.05.2026", "a date without a time of day"),
        ("09:30:05.25", "a time of day without a date"),
        ("2026-13-04T09:30:05Z", "not a time"),
        ("", "not a time"),
        ("nan", "not a time"),
        ("inf", "not a time"),
        ("1_000", "not a time"),
        ("1777887005250", "out of range"),
        ("1e400", "out of range"),
    ],
)
def test_what_is_not_a_time_is_refused_with_a_remedy(text: str, words: str) -> None:
    with pytest.raises(KgcpError, match=words) as caught:
        parse_time(text)
    assert "Unix seconds" in str(caught.value)


def test_written_times_are_utc_with_microseconds() -> None:
    assert format_time(MORNING + 5.25) == "2026-05-04T09:30:05.250000Z"
    assert format_time(-0.5) == "1969-12-31T23:59:59.500000Z"


@given(st.floats(min_value=-1e9, max_value=4e9))
def test_written_times_read_back_to_a_microsecond(unix_s: float) -> None:
    assert parse_time(format_time(unix_s)) == pytest.approx(unix_s, rel=0.0, abs=1e-6)


@given(st.datetimes(timezones=st.just(None)).filter(lambda t: 1970 <= t.year <= 2100))
def test_microseconds_survive_the_round_trip(moment: datetime) -> None:
    text = f"{moment.isoformat(timespec='microseconds')}Z"
    assert format_time(parse_time(text)) == text
