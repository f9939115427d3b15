"""Frames against trajectory and EXIF in time: the errors that clocks make."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.gps_counts import gps_count_remedy
from kgcp.georef.unix_time import date_of
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild

_WEEK_S = 604_800.0
_ROLLOVER_S = 1024 * _WEEK_S
_HOUR_S, _DAY_S = 3600.0, 86_400.0
GPS_MINUS_UTC_S, TAI_MINUS_UTC_S = 18.0, 37.0
_LEAP_TOLERANCE_S = 1.2  # EXIF has whole seconds
_HOUR_TOLERANCE_S = 60.0
_STEADY_S = 2.0
_SAME_SHARE = 0.02  # of the interval between frames
_MOST_OUTSIDE = 0.1  # of the frames: some are taken before a logger starts
_MOSTLY = 0.5
_FEWEST_WHOLE = 5  # times; fewer may be whole seconds by chance
_CHECK_DATES = (
    "check the date and GPS week of both files: [vehicle] date names the first day of a trajectory"
    " in seconds of the week"
)
"""Not time_offset_s, with which points would have the time of the wrong day."""


def clock_shifts_s() -> Iterator[tuple[float, str]]:
    """Yield what clocks differ by, the likelier first, as seconds and in words.

    A shift is what is to be added to frame times.
    """
    signs = (-1.0, 1.0)
    for sign in signs:
        ahead = "the frames'" if sign < 0.0 else "the trajectory's"
        yield sign * GPS_MINUS_UTC_S, f"{ahead} times seem to be GPS time, not UTC"
        yield sign * TAI_MINUS_UTC_S, f"{ahead} times seem to be TAI, not UTC"
        tai_minus_gps_s = TAI_MINUS_UTC_S - GPS_MINUS_UTC_S
        yield sign * tai_minus_gps_s, f"{ahead} times seem to be TAI, not GPS"
    quarters = [*range(4, 57, 4), 22, 14, 18, 23, 26, 38, 42, 46, 51]  # zones of ½ and ¾ hours, too
    for quarter, sign in product(quarters, signs):
        yield sign * quarter * 0.25 * _HOUR_S, "one of them seems to be local time"
    for sign in signs:
        yield sign * _DAY_S, "they are of another day"
    for hours, leap_s, sign in product(range(1, 15), (GPS_MINUS_UTC_S, -GPS_MINUS_UTC_S), signs):
        yield sign * (hours * _HOUR_S + leap_s), "one of them seems to be local time, and of GPS"
    for sign in signs:
        yield sign * _WEEK_S, "they are of another GPS week"
    for rollovers, sign in product((1, 2), signs):
        yield sign * rollovers * _ROLLOVER_S, "GPS weeks are counted modulo 1024 in one of them"


def check_overlap(
    frame_s: FloatArray, trajectory_s: FloatArray, time_offset_s: float
) -> Iterator[Doubt]:
    """Tell frames (n,) outside of a trajectory (m,) in time; try what would bring them inside.

    Both in Unix UTC [s]; `time_offset_s` is that of flight.toml.
    """
    first, last = float(trajectory_s[0]), float(trajectory_s[-1])
    times = frame_s + time_offset_s
    outside = float(np.mean((times < first) | (times > last))) if len(times) else 0.0
    doubt = grave if outside > _MOSTLY else mild  # a logger may have been started late
    if outside <= _MOST_OUTSIDE:
        return
    count = round(outside * len(times))
    figures = {"frames_outside": float(count), "frames": float(len(times))}
    offset = f", time_offset_s = {time_offset_s:g}" if time_offset_s else ""
    sentence = (
        f"{count} of {len(times)} frames with a time lie outside the trajectory (frames"
        f" {time_span(frame_s)}{offset}; trajectory {time_span(trajectory_s)})"
    )
    remedy = gps_count_remedy(float(times.min()), first)
    if remedy is not None:
        yield grave(Cause.CLOCK, sentence, remedy, figures)
        return
    for shift_s, words in clock_shifts_s():
        if np.mean((times + shift_s >= first) & (times + shift_s <= last)) > 1.0 - 0.02:
            which = "later" if shift_s > 0.0 else "earlier"
            remedy = (
                "give [vehicle] time_system, correct the times file, or set [vehicle]"
                f" time_offset_s = {time_offset_s + shift_s:g}"
            )
            yield doubt(
                Cause.CLOCK,
                f"{sentence}: {words}; {_seconds(abs(shift_s))} {which} all would lie inside",
                _CHECK_DATES if shift_s % _DAY_S == 0.0 else remedy,
                {**figures, "shift_s": shift_s},
            )
            return
    days = _whole_days(times, first, last)
    if days is not None:
        is_week = days % 7 == 0
        words = f"{abs(days)} days" + (f", {abs(days) // 7} GPS weeks," if is_week else "")
        yield grave(
            Cause.CLOCK,
            f"{sentence}: they are {words} apart",
            _CHECK_DATES,
            {**figures, "shift_s": days * _DAY_S},
        )
    elif outside == 1.0:  # blocks partly inside are flown for longer than vehicles drive
        yield grave(
            Cause.NO_OVERLAP,
            sentence,
            "give the trajectory of this flight, or correct [vehicle] time_offset_s, time_system",
            figures,
        )


def check_completeness(frames: Sequence[str], times_s: Mapping[str, float]) -> Iterator[Doubt]:
    """Tell frames without a time: the vehicle's place in them is not known."""
    untimed = [frame for frame in frames if frame not in times_s]
    if not untimed:
        return
    figures = {"frames_without_time": float(len(untimed)), "frames": float(len(frames))}
    have = "has" if len(untimed) == 1 else "have"
    sentence = f"{len(untimed)} of {len(frames)} frames {have} no time, such as {untimed[0]}"
    remedy = "give [frames] times with one line per frame, named as below the frames folder"
    doubt = grave if len(untimed) == len(frames) else mild
    yield doubt(Cause.NO_TIMES, sentence, remedy, figures)


def check_fractions(frame_s: FloatArray) -> Iterator[Doubt]:
    """Tell frame times (n,) that are all whole seconds: of clocks that have no others, or cut.

    Spreadsheets cut numbers of ten digits where the column is narrow, and save them so.
    """
    if len(frame_s) < _FEWEST_WHOLE or np.any(frame_s != np.rint(frame_s)):
        return
    yield mild(
        Cause.WHOLE_SECONDS,
        f"all {len(frame_s)} frame times are whole seconds, in which a vehicle moves metres",
        "give times to the millisecond; if a spreadsheet has cut them, export the file again",
        {"frames": float(len(frame_s))},
    )


def check_same_times(times_s: Mapping[str, float]) -> Iterator[Doubt]:
    """Tell frames that have the time of another: one camera takes one photograph at a time."""
    first_of: dict[float, str] = {}
    pairs = [
        (frame, first_of[times_s[frame]])
        for frame in sorted(times_s)
        if first_of.setdefault(times_s[frame], frame) != frame
    ]
    if not pairs:
        return
    frame, first = pairs[0]
    have = "has" if len(pairs) == 1 else "have"
    yield mild(
        Cause.SAME_TIMES,
        f"{len(pairs)} of {len(times_s)} frames {have} the time of another frame, such as {frame}"
        f" that of {first}",
        "take copies of frames out of the folder, since each counts as an observation of its own;"
        " if the times are in whole seconds, give better ones",
        {"frames": float(len(pairs))},
    )


def check_exif_times(times_s: Sequence[float], exif_s: Sequence[float]) -> Iterator[Doubt]:
    """Compare the times of frames with those that their EXIF has, both Unix UTC [s], in pairs.

    A camera's clock is often set by hand and drifts. Only a steady difference of leap seconds,
    hours or weeks tells something.
    """
    if len(times_s) < 3:
        return
    difference = np.asarray(times_s) - np.asarray(exif_s)
    middle = float(np.median(difference))
    spread = float(np.median(np.abs(difference - middle)))
    if spread > _STEADY_S:
        yield mild(
            Cause.FRAME_ORDER,
            f"the frames' times and those of their EXIF differ by {difference.min():.1f} …"
            f" {difference.max():.1f} s: the times may belong to other frames",
            "check that every line of the times file has the time of the frame it names",
            {"spread_s": spread},
        )
        return
    interval = float(np.median(np.abs(np.diff(exif_s))))
    for step, word in ((1, "next"), (-1, "previous")):
        moved = np.roll(np.asarray(exif_s), -step)[1:-1] - np.asarray(times_s)[1:-1]
        if abs(middle) > 0.5 * interval and np.median(np.abs(moved)) < _SAME_SHARE * interval:
            yield mild(
                Cause.FRAME_ORDER,
                f"the frames' times are those that the EXIF of the {word} frame has",
                "check that every line of the times file has the time of the frame it names",
                {"difference_s": middle},
            )
            return
    likely = [
        words
        for shift_s, words in clock_shifts_s()
        if abs(middle + shift_s)
        < (_LEAP_TOLERANCE_S if abs(shift_s) < _HOUR_TOLERANCE_S else _HOUR_TOLERANCE_S)
    ]
    if not likely:
        return
    words = likely[0].replace("the trajectory's times seem", "EXIF times seem")
    words = words.replace("the frames' times seem", "those of the times file seem")
    yield mild(
        Cause.CLOCK,
        f"the frames' times are {_seconds(abs(middle))} {'after' if middle > 0 else 'before'}"
        f" those of their EXIF: {words}",
        "check which clock is right; correct the times file, or set [vehicle] time_offset_s",
        {"difference_s": middle},
    )


def _whole_days(times: FloatArray, first: float, last: float) -> int | None:
    """Return the whole days (of any number) that bring all times inside, if any do."""
    days = round((0.5 * (first + last) - float(np.median(times))) / _DAY_S)
    if not days:
        return None
    moved = times + days * _DAY_S
    return days if np.mean((moved >= first) & (moved <= last)) > 1.0 - 0.02 else None


def time_span(times_s: FloatArray) -> str:
    """Return the first and the last of some times, Unix UTC [s], in words."""
    first, last = (date_of(float(t)) for t in (times_s.min(), times_s.max()))
    end = last.strftime("%H:%M:%S" if last.date() == first.date() else "%Y-%m-%d %H:%M:%S")
    return f"{first:%Y-%m-%d %H:%M:%S} to {end}"


def _seconds(seconds: float) -> str:
    """Return a time span in the unit that suits it."""
    for unit_s, unit in ((_DAY_S, "days"), (_HOUR_S, "h")):
        if seconds >= unit_s:
            return f"{seconds / unit_s:.6g} {unit}"
    return f"{seconds:.4g} s"
