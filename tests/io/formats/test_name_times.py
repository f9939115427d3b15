from __future__ import annotations

import pytest

from kgcp.io.formats.name_times import times_of_names


@pytest.mark.parametrize(
    ("stem", "time_s"),
    [
        ("1781597705.000336", 1781597705.000336),
        ("cam0_1781597705_000336", 1781597705.000336),
        ("1781597705000", 1781597705.0),
        ("1781597705000336", 1781597705.000336),
        ("left-1781597705000336000", 1781597705.000336),
        ("20260616T081505.250Z", 1781597705.25),
        ("img_2026-06-16_08-15-05-250000Z", 1781597705.25),
    ],
)
def test_times_are_read_from_file_names(stem: str, time_s: float) -> None:
    times = times_of_names([f"cam/{stem}.png"])
    assert times is not None
    assert times[f"cam/{stem}.png"] == pytest.approx(time_s, abs=1e-6)


def test_microseconds_are_no_numbers_of_frames() -> None:
    names = ["1781597705_000336.png", "1781597706_500540.png", "1781597708_000338.png"]
    times = times_of_names(names)
    assert times is not None
    assert times[names[1]] == pytest.approx(1781597706.50054, abs=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["frame_0001.png"],
        ["DJI_20260616101505_0001_V.JPG"],  # local time, whole seconds
        ["20260616T081505Z.png"],
        ["1781597705.png"],
        ["20261316T081505.5Z.png"],
        ["1781597705.5.png", "other.png"],
        ["1781597705_000012.png", "1781597705_000013.png", "1781597706_000014.png"],  # counted
        ["a/1781597705.5.png", "b/1781597705.5.png"],  # two frames of one moment
    ],
)
def test_names_without_usable_times_give_none(names: list[str]) -> None:
    assert times_of_names(names) is None
