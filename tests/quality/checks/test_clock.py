from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.checks.clock import (
    check_exif_deviation,
    check_exif_times,
    check_fractions,
    check_overlap,
    check_same_times,
)
from kgcp.quality.checks.doubt import Cause

START_S = 1_781_597_700.0
TRAJECTORY_S: FloatArray = START_S + np.arange(0.0, 45.0, 0.05)
FRAMES_S: FloatArray = START_S + 5.0 + 1.5 * np.arange(24.0)
NAMES = [f"{number}.jpg" for number in range(24)]


def test_frames_within_the_trajectory_raise_no_doubt() -> None:
    assert not [*check_overlap(FRAMES_S, TRAJECTORY_S, 0.0)]
    assert not [*check_overlap(FRAMES_S + 6.0, TRAJECTORY_S, 0.0)]  # the last 2 of 24 are outside
    assert not [*check_overlap(FRAMES_S - 18.0, TRAJECTORY_S, 18.0)]
    assert not [*check_overlap(np.array([]), TRAJECTORY_S, 0.0)]


def test_times_in_whole_seconds_are_reported() -> None:
    """As a spreadsheet leaves Unix seconds."""
    assert not [*check_fractions(FRAMES_S, 0.0)]
    assert not [*check_fractions(np.floor(FRAMES_S[:4]), 0.0)]
    (doubt,) = check_fractions(np.floor(FRAMES_S), 0.1)
    assert (doubt.code, doubt.is_grave) == (Cause.WHOLE_SECONDS, False)
    assert "all 24 frame times are whole seconds" in doubt.sentence


@pytest.mark.parametrize(("step_s", "sd_s"), [(0.1, 0.03), (0.01, 0.003)])
def test_times_that_are_rounded_more_coarsely_than_stated_are_reported(
    step_s: float, sd_s: float
) -> None:
    """As by cameras that write one or two digits of the fraction."""
    exact = START_S + 5.0013 + 1.5371 * np.arange(24.0)
    assert not [*check_fractions(exact, 0.0)]
    for rounded in (np.rint(exact / step_s), np.floor(exact / step_s)):
        times = np.round(1e6 * step_s * rounded) / 1e6
        (doubt,) = check_fractions(times, 0.001)
        assert (doubt.code, doubt.is_grave) == (Cause.COARSE_TIMES, False)
        assert f"rounded to {step_s:g} s" in doubt.sentence
        assert f"at least {sd_s:g}" in doubt.remedy
        assert not [*check_fractions(times, sd_s)]


@pytest.mark.parametrize("period_s", [0.04, 0.1, 0.5, 1.5])
def test_times_of_a_trigger_are_not_rounded(period_s: float) -> None:
    """A trigger on the receiver's clock, also where most frames are left out."""
    ticks = np.array([0, 1, 2, 4, 5, 9, 11, 12, 40, 41, 46, 47])
    assert not [*check_fractions(START_S + period_s * ticks, 0.0)]


def test_times_of_exif_do_not_count_as_exact() -> None:
    (doubt,) = check_exif_deviation(0.0)
    assert (doubt.code, doubt.is_grave) == (Cause.STANDARD_DEVIATIONS, False)
    assert not [*check_exif_deviation(0.05)]


@pytest.mark.parametrize(
    ("ahead_s", "words"),
    [
        (18.0, "the frames' times seem to be GPS time"),
        (-18.0, "the trajectory's times seem to be GPS time"),
        (37.0, "the frames' times seem to be TAI"),
        (7200.0, "local time; 2 h earlier"),
        (-5.5 * 3600.0, "local time; 5.5 h later"),
        (3600.0 + 18.0, "a time zone and by GPS minus UTC"),
        (86_400.0, "different days"),
        (-604_800.0, "different GPS weeks"),
        (1024 * 604_800.0, "modulo 1024"),
        (3 * 604_800.0, "21 days, 3 GPS weeks, apart"),
        (40 * 86_400.0, "40 days apart"),
    ],
)
def test_the_shift_that_fits_is_named(ahead_s: float, words: str) -> None:
    (doubt,) = check_overlap(FRAMES_S + ahead_s, TRAJECTORY_S, 0.0)
    assert (doubt.code, doubt.is_grave) == (Cause.CLOCK, abs(ahead_s) > 20.0)
    is_date = ahead_s % 86_400.0 == 0.0
    assert ("[vehicle] date" in doubt.remedy, "time_offset_s" in doubt.remedy) == (
        is_date,
        not is_date,
    )
    assert words in doubt.sentence
    assert doubt.figures["shift_s"] == pytest.approx(-ahead_s)


def test_frames_of_another_drive_are_reported() -> None:
    (doubt,) = check_overlap(FRAMES_S + 500.0, TRAJECTORY_S, 0.0)
    assert (doubt.code, doubt.is_grave) == (Cause.NO_OVERLAP, True)
    assert "24 of 24 frames" in doubt.sentence
    long = START_S + 5.0 + 1.5 * np.arange(-100.0, 100.0)
    assert not [*check_overlap(long, TRAJECTORY_S, 0.0)]  # the vehicle drove for a part of it


@pytest.mark.parametrize(
    ("ahead_s", "words"),
    [
        (18.0, "those of the times file seem to be GPS time"),
        (-18.0, "EXIF times seem to be GPS time"),
        (3600.0, "local time"),
    ],
)
def test_a_clock_that_contradicts_exif_is_reported(ahead_s: float, words: str) -> None:
    exif = np.floor(FRAMES_S)
    (doubt,) = check_exif_times(NAMES, [*(FRAMES_S + ahead_s)], [*exif])
    assert (doubt.code, doubt.is_grave) == (Cause.CLOCK, False)
    assert words in doubt.sentence


def test_a_constant_offset_of_the_camera_clock_raises_no_doubt() -> None:
    for ahead_s in (0.0, 0.4, 5.0, -61.0, 1000.0):
        assert not [*check_exif_times(NAMES, [*(FRAMES_S + ahead_s)], [*FRAMES_S])]


def test_times_assigned_to_other_frames_are_reported() -> None:
    (doubt,) = check_exif_times(NAMES, [*FRAMES_S[::-1]], [*FRAMES_S])
    assert doubt.code is Cause.FRAME_ORDER


def test_frames_with_the_time_of_another_are_counted() -> None:
    times_s = {f"{number}.jpg": START_S + number for number in range(5)}
    assert not [*check_same_times(times_s)]
    (doubt,) = check_same_times(times_s | {"3 (1).jpg": START_S + 3, "4.tif": START_S + 4})
    assert (doubt.code, doubt.is_grave) == (Cause.SAME_TIMES, False)
    assert (
        "2 of 7 frames have the time of another frame; 3.jpg, for example, has that of 3 (1).jpg"
        in (doubt.sentence)
    )


@pytest.mark.parametrize(("zone_s", "is_zone_known"), [(0.0, True), (7200.0, False)])
@pytest.mark.parametrize("count", [1, 8])
def test_frames_with_the_times_of_others_are_named(
    zone_s: float, count: int, *, is_zone_known: bool
) -> None:
    """As of a second folder of a drone, whose numbers begin anew."""
    exif = np.floor(FRAMES_S) + zone_s + 0.7
    assert not [*check_exif_times(NAMES, [*FRAMES_S], [*exif], is_zone_known=is_zone_known)]
    exif[12 : 12 + count] += 600.0
    (doubt,) = check_exif_times(NAMES, [*FRAMES_S], [*exif], is_zone_known=is_zone_known)
    assert (doubt.code, doubt.is_grave) == (Cause.FRAME_ORDER, False)
    assert f"the times of {count} of 24 frames, such as 12.jpg, are up to 600" in doubt.sentence
