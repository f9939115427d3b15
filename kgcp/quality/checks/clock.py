"""Checks of frame times against trajectory and EXIF, and the usual errors of clocks."""

from __future__ import annotations

import math
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
_LEAP_TOLERANCE_S = 1.2  # of differences in seconds, because EXIF has whole seconds
_HOUR_TOLERANCE_S = 60.0  # of differences in hours and more
_MAX_SPREAD_S = 2.0  # of a steady difference, by the median
_MAX_LONE_S = (
    3.0  # of the same in a single frame; EXIF has whole seconds, or when the file is begun
)
_SAME_TIME_SHARE = 0.02  # of the interval between frames, below which times count as equal
_MAX_OUTSIDE_SHARE = 0.1  # of the frames: some are taken before a logger starts
_GRAVE_OUTSIDE_SHARE = 0.5
MIN_EXIF_TIMES = 3
"""Least number of frames whose times can be compared with those of their EXIF."""
_MIN_WHOLE_SECONDS = 5  # fewer times may be whole seconds by chance
_COARSE_STEPS_S = (0.1, 0.01)  # of rounded times; milliseconds are good enough
_MIN_ROUNDED = 8  # fewer times in milliseconds may be hundredths by chance
_STEP_TOLERANCE = 1e-3  # of a step, by which times are off that are written in microseconds
_LIVELY_M_S = 10.0  # speed of a vehicle, for messages
_CHECK_DATES = (
    "check the date and GPS week of both files: [vehicle] date names the first day of a trajectory"
    " in seconds of the week"
)
"""The remedy is not time_offset_s: with it, points would have times on the wrong day."""


def clock_shifts_s() -> Iterator[tuple[float, str]]:
    """Yield usual differences between clocks, the likelier first, in seconds and in words.

    The difference is to be added to frame times.
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
        yield sign * _DAY_S, "they are of different days"
    for hours, leap_s, sign in product(range(1, 15), (GPS_MINUS_UTC_S, -GPS_MINUS_UTC_S), signs):
        yield (
            sign * (hours * _HOUR_S + leap_s),
            "they seem to differ by a time zone and by GPS minus UTC",
        )
    for sign in signs:
        yield sign * _WEEK_S, "they are of different GPS weeks"
    for rollovers, sign in product((1, 2), signs):
        yield sign * rollovers * _ROLLOVER_S, "GPS weeks are counted modulo 1024 in one of them"


def check_overlap(
    frame_s: FloatArray, trajectory_s: FloatArray, time_offset_s: float
) -> Iterator[Doubt]:
    """Yield the doubt about frames (n,) that lie outside a trajectory (m,) in time.

    Usual differences between clocks are tried for one that brings the frames inside. Both times are
    Unix UTC [s]; `time_offset_s` is that of flight.toml.
    """
    first, last = float(trajectory_s[0]), float(trajectory_s[-1])
    times = frame_s + time_offset_s
    outside = float(np.mean((times < first) | (times > last))) if len(times) else 0.0
    # few frames outside may have been taken before the logger was started
    doubt = grave if outside > _GRAVE_OUTSIDE_SHARE else mild
    if outside <= _MAX_OUTSIDE_SHARE:
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
                f"{sentence}: {words}; {_seconds(abs(shift_s))} {which}, all would lie inside",
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
    elif outside == 1.0:  # if some are inside, the flight just lasted longer than the drive
        yield grave(
            Cause.NO_OVERLAP,
            sentence,
            "give the trajectory of this flight, or correct [vehicle] time_offset_s, time_system",
            figures,
        )


def check_completeness(frames: Sequence[str], times_s: Mapping[str, float]) -> Iterator[Doubt]:
    """Yield the doubt about frames without a time, in which the vehicle's position is unknown."""
    untimed = [frame for frame in frames if frame not in times_s]
    if not untimed:
        return
    figures = {"frames_without_time": float(len(untimed)), "frames": float(len(frames))}
    have = "has" if len(untimed) == 1 else "have"
    sentence = f"{len(untimed)} of {len(frames)} frames {have} no time, such as {untimed[0]}"
    remedy = "give [frames] times with one line per frame, named relative to the frames folder"
    doubt = grave if len(untimed) == len(frames) else mild
    yield doubt(Cause.NO_TIMES, sentence, remedy, figures)


def check_fractions(frame_s: FloatArray, sd_time_s: float) -> Iterator[Doubt]:
    """Yield the doubt about frame times (n,) that are all whole seconds, or coarsely rounded.

    Either the clock has no finer fractions, or they were lost: spreadsheets round numbers of ten
    digits in narrow columns, and save them so. `sd_time_s` is that of flight.toml [s].
    """
    if len(frame_s) < _MIN_WHOLE_SECONDS or np.any(frame_s != np.rint(frame_s)):
        yield from _check_rounding(np.unique(frame_s), sd_time_s)
        return
    yield mild(
        Cause.WHOLE_SECONDS,
        f"all {len(frame_s)} frame times are whole seconds; a vehicle moves metres in a second",
        "give times to the millisecond; if a spreadsheet has rounded them, export the file again",
        {"frames": float(len(frame_s))},
    )


def _check_rounding(times: FloatArray, sd_time_s: float) -> Iterator[Doubt]:
    """Yield the doubt about ascending times (n,) in tenths or hundredths of a second.

    A trigger may fire at such times exactly. Then all intervals are multiples of the shortest one,
    even where frames are missing; those of rounded times vary by a step.
    """
    for step_s in _COARSE_STEPS_S:
        sd_s = step_s / math.sqrt(12.0)
        counts = np.rint(times / step_s)
        if len(times) < _MIN_ROUNDED or np.any(abs(times / step_s - counts) > _STEP_TOLERANCE):
            continue
        intervals = np.diff(counts).astype(np.int64)
        if sd_time_s < sd_s and np.any(intervals % intervals.min()):
            yield mild(
                Cause.COARSE_TIMES,
                f"all {len(times)} frame times are rounded to {step_s:g} s, but [vehicle] sd_time_s"
                f" is {sd_time_s:g} s: a vehicle moves"
                f" {_LIVELY_M_S * step_s:g} m in {step_s:g} s at {_LIVELY_M_S:g} m/s",
                "give times to the millisecond, or set [vehicle] sd_time_s to at least"
                f" {sd_s:.1g}, twice that if they are cut off",
                {"step_s": step_s, "sd_time_s": sd_time_s},
            )
        return


def check_exif_deviation(sd_time_s: float) -> Iterator[Doubt]:
    """Yield the doubt about times of EXIF that count as exact, by the sd_time_s of flight.toml."""
    if sd_time_s == 0.0:
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            "the frames' times are of the camera's clock (EXIF), and [vehicle] sd_time_s is 0 or"
            " missing: they count as exact, and standard deviations of points leave them out",
            "give a times file, or state in sd_time_s how well the camera's clock was set",
            {"sd_time_s": sd_time_s},
        )


def check_same_times(times_s: Mapping[str, float]) -> Iterator[Doubt]:
    """Yield the doubt about frames with equal times: a camera takes one photograph at a time."""
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
        f"{len(pairs)} of {len(times_s)} frames {have} the time of another frame; {frame}, for"
        f" example, has that of {first}",
        "remove copies of frames from the folder, because each counts as an observation of its"
        " own; if the times are in whole seconds, give more precise ones",
        {"frames": float(len(pairs))},
    )


def check_exif_times(
    frames: Sequence[str],
    times_s: Sequence[float],
    exif_s: Sequence[float],
    *,
    is_zone_known: bool = True,
) -> Iterator[Doubt]:
    """Compare the times of frames with those in their EXIF, both Unix UTC [s].

    A camera's clock is often set by hand, and drifts. Only a steady difference of leap seconds,
    hours or weeks points to an error, and differences that are not the same in all frames.

    Parameters
    ----------
    is_zone_known : bool
        Whether EXIF states the zone; if not, its times are those of a clock of any zone.
    """
    if len(times_s) < MIN_EXIF_TIMES:
        return
    difference = np.asarray(times_s) - np.asarray(exif_s)
    middle = float(np.median(difference))
    spread = float(np.median(np.abs(difference - middle)))
    if spread > _MAX_SPREAD_S:
        yield mild(
            Cause.FRAME_ORDER,
            f"the frames' times and those of their EXIF differ by {difference.min():.1f} …"
            f" {difference.max():.1f} s: the times may belong to other frames",
            "check that every line of the times file has the time of the frame it names",
            {"spread_s": spread},
        )
        return
    yield from _check_lone_times(frames, difference, middle)
    if not is_zone_known:
        return
    interval = float(np.median(np.abs(np.diff(exif_s))))
    for step, word in ((1, "next"), (-1, "previous")):
        moved = np.roll(np.asarray(exif_s), -step)[1:-1] - np.asarray(times_s)[1:-1]
        if abs(middle) > 0.5 * interval and np.median(np.abs(moved)) < _SAME_TIME_SHARE * interval:
            yield mild(
                Cause.FRAME_ORDER,
                f"the frames' times are those in the EXIF of the {word} frame",
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


def _check_lone_times(
    frames: Sequence[str], difference_s: FloatArray, middle_s: float
) -> Iterator[Doubt]:
    """Yield the doubt about frames whose times differ from EXIF (n,) otherwise than those of most.

    Numbers by which times are assigned repeat in every folder of some drones.
    """
    off_s = difference_s - middle_s
    others = np.flatnonzero(np.abs(off_s) > _MAX_LONE_S)
    if not len(others):
        return
    worst_s = float(np.abs(off_s).max())
    yield mild(
        Cause.FRAME_ORDER,
        f"the times of {len(others)} of {len(frames)} frames, such as {frames[int(others[0])]}, are"
        f" up to {_seconds(worst_s)} from those of their EXIF, if the other frames' are right",
        "check that every line of the times file has the time of the frame it names, and that"
        " frames have not been renamed",
        {"frames": float(len(others)), "difference_s": worst_s},
    )


def _whole_days(times: FloatArray, first: float, last: float) -> int | None:
    """Return the number of whole days that brings all times inside; None if none does."""
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
    """Return a time span in a suitable unit."""
    for unit_s, unit in ((_DAY_S, "d"), (_HOUR_S, "h")):
        if seconds >= unit_s:
            return f"{seconds / unit_s:.6g} {unit}"
    return f"{seconds:.4g} s"
