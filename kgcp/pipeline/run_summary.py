"""Counts and times of a detection run over all frames."""

from __future__ import annotations

import re
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

from kgcp.errors import Reason, Status
from kgcp.io.formats.frame_names import likely_difference
from kgcp.measurement.records import FrameResult, Measurement, Miss, TimeSource
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.checks.plate import SeenPrint
from kgcp.quality.checks.static_targets import PlainSearch
from kgcp.quality.learnt_imaging import LearntImaging

_MAX_DETAILS = 1000  # different details kept per reason; numbers in them differ between frames
_PLACE = re.compile(r"ring at \([^)]*\), radius [\d.]+ px(, |: |$)")
_PREDICTION = re.compile(r"(^|; )expected by .*")
_NUMBERS_OF_TEST = re.compile(r" \([^()]*\)$")
_NUMBER = re.compile(r"-?\d+(\.\d+)?")
_MAX_PRINTS = 10_000  # measurements that show how the targets are printed
_MAX_SEARCHES = 10_000  # searches that show how good the reference poses are
_MAX_COMPARED = 1000  # differing names among which two similar ones are searched for


@dataclass(frozen=True, slots=True)
class DetectionSummary:
    """Counts over a flight.

    Attributes
    ----------
    table : Path
        File of the detections.
    frames : int
        Frames examined.
    status : dict of int
        Rows per status.
    reasons : dict of int
        Rows per reason, most frequent first.
    details : dict of str
        The most frequent detail of each reason that has any.
    likely_cause : str or None
        Why nothing was measured, if a trial showed it.
    frames_not_chosen : int
        Frames that match no wanted pattern.
    frames_without_time : int
        Frames to which neither the times file nor EXIF gives a time.
    frames_not_in_times_file : int
        Frames that the times file, if there is one, does not name.
    times_without_frame : int
        Entries of the times file that name no frame.
    name_difference : str or None
        How the name in such an entry differs from that of the frame that it probably means.
    exif_times_in_whole_seconds : int
        Frames whose time is EXIF's, if all of these times are whole seconds; else 0.
    frames_without_attitude : int
        Frames whose camera attitude is not known, so that the level plate does not help to choose
        between two poses; 0 if the plate is not stated to be level.
    kept : int
        Frames that an interrupted run had already examined.
    guided : int
        Rows that only a second look has measured.
    not_drawn : int
        Rings that are not in the contact sheet, since their frame could not be read again.
    guide_problem : str or None
        Why reference poses and trajectory could not predict missing targets; None: they could.
    tone_base : str or None
        The known curve to which the frames' tone curve is close; None: not learnt, or close to
        none.
    measured_with_tone, overruled_by_tone, kept_other_tone : int
        Numbers of measurements from which the base was learnt, of those that it changed, and of
        those that keep another base because they fit it much better.
    stages_s : dict of float
        Time that each stage of the work took [s].
    doubts : tuple of Doubt
        About the prints and the reference poses, each from up to 10 000 rows together.
    """

    table: Path
    frames: int
    status: Mapping[str, int]
    reasons: Mapping[str, int]
    details: Mapping[str, str]
    likely_cause: str | None
    frames_not_chosen: int
    frames_without_time: int
    frames_not_in_times_file: int
    times_without_frame: int
    name_difference: str | None
    exif_times_in_whole_seconds: int
    frames_without_attitude: int
    kept: int
    guided: int
    not_drawn: int
    guide_problem: str | None
    tone_base: str | None
    measured_with_tone: int
    overruled_by_tone: int
    kept_other_tone: int
    stages_s: Mapping[str, float]
    doubts: tuple[Doubt, ...]

    @property
    def problem(self) -> str | None:
        """Why a run has measured nothing, in one line with the remedy; None if it has."""
        if self.status[Status.MEASURED.value]:
            return None
        text = f"no target was measured in any of {self.frames} frames"
        if self.likely_cause is not None:
            return f"{text}: {self.likely_cause}"
        reason, count = next(iter(self.reasons.items()))
        detail = f" ({self.details[reason]})" if reason in self.details else ""
        return f"{text}: {count} {reason}{detail}; {Reason.of(reason).remedy}"

    def numbers(self) -> dict[str, object]:
        """Return all attributes but the table and the doubts, by name, for JSON."""
        others = {"table", "doubts"}
        return {name: value for name, value in asdict(self).items() if name not in others}


class Stopwatch:
    """Measures the time of each stage."""

    def __init__(self) -> None:
        self.stages_s: dict[str, float] = defaultdict(float)  # by the stage's name
        self._start_s = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of a block, even if it raises."""
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.stages_s[name] += time.perf_counter() - start_s

    @property
    def seconds(self) -> float:
        """Time since the stopwatch was started [s]."""
        return time.perf_counter() - self._start_s


class SummaryBuilder:
    """Counts rows and frames, one frame after the other.

    Parameters
    ----------
    times : mapping of str to float
        Times in the times file, by frame.
    """

    def __init__(self, times: Mapping[str, float]) -> None:
        self._times = times
        self._frames = self._without_time = self._guided = 0
        self._named: set[str] = set()
        self._not_named: list[str] = []
        self._status: Counter[Status] = Counter()
        self._reasons: Counter[Reason] = Counter()
        self._details: dict[Reason, Counter[str]] = defaultdict(Counter)
        self._from_exif: Counter[bool] = Counter()  # by whether the time is a whole second
        self.prints: list[SeenPrint] = []  # of the first measurements
        self.searches: list[PlainSearch] = []  # the first ones

    def add(self, result: FrameResult, searches: Iterable[PlainSearch] = ()) -> None:
        """Count a frame, and keep its searches for plain targets by its reference pose."""
        self.searches += islice(searches, _MAX_SEARCHES - len(self.searches))
        self._frames += 1
        self._without_time += result.time_s is None
        if result.frame in self._times:
            self._named.add(result.frame)
        elif self._times:
            self._not_named.append(result.frame)
        if result.time_source is TimeSource.EXIF and result.camera_time_s is not None:
            self._from_exif[result.camera_time_s.is_integer()] += 1
        for outcome in result.outcomes:
            if isinstance(outcome, Miss):
                self._reasons[outcome.reason] += 1
                self._status[outcome.reason.status] += 1
                self._count_detail(outcome)
            else:
                self._status[Status.MEASURED] += 1
                self._guided += outcome.is_guided
                self._add_print(outcome)

    def _add_print(self, measurement: Measurement) -> None:
        appearance = measurement.appearance
        if len(self.prints) < _MAX_PRINTS:
            inner_growth, dots_growth = appearance.inner_growth, appearance.dots_growth
            self.prints.append(
                SeenPrint(measurement.target, measurement.distance_m, inner_growth, dots_growth)
            )

    def _count_detail(self, miss: Miss) -> None:
        counts, text = self._details[miss.reason], _without_place(miss.detail)
        if text and (text in counts or len(counts) < _MAX_DETAILS):
            counts[text] += 1

    def summary(
        self,
        *,
        table: Path,
        likely_cause: str | None,
        frames_not_chosen: int,
        kept: int,
        frames_without_attitude: int,
        not_drawn: int,
        guide_problem: str | None,
        learnt: LearntImaging | None,
        stages_s: Mapping[str, float],
        doubts: Sequence[Doubt],
    ) -> DetectionSummary:
        """Return the counts together with other results of the run."""
        unused = [name for name in self._times if name not in self._named]
        return DetectionSummary(
            table=table,
            frames=self._frames,
            status={kind.value: self._status[kind] for kind in Status},
            reasons={reason.value: count for reason, count in self._reasons.most_common()},
            details={
                reason.value: _commonest(counts)
                for reason, counts in self._details.items()
                if counts and reason is not Reason.OUT_OF_VIEW
            },
            likely_cause=likely_cause,
            frames_not_chosen=frames_not_chosen,
            frames_without_time=self._without_time,
            frames_not_in_times_file=len(self._not_named),
            times_without_frame=len(unused),
            name_difference=_name_difference(unused, self._not_named),
            exif_times_in_whole_seconds=0 if self._from_exif[False] else self._from_exif[True],
            frames_without_attitude=frames_without_attitude,
            kept=kept,
            guided=self._guided,
            not_drawn=not_drawn,
            guide_problem=guide_problem,
            tone_base=None if learnt is None or learnt.base is None else learnt.base.value,
            measured_with_tone=0 if learnt is None else learnt.measurements,
            overruled_by_tone=0 if learnt is None else learnt.overruled,
            kept_other_tone=0 if learnt is None else learnt.kept_own_base,
            stages_s=dict(stages_s),
            doubts=tuple(doubts),
        )


def _without_place(detail: str) -> str:
    """Return the part of a detail that may be the same in other frames."""
    text = _PLACE.sub("", _PREDICTION.sub("", detail))
    return _NUMBERS_OF_TEST.sub("", text)


def _commonest(details: Counter[str]) -> str:
    """Return the most frequent detail; those that differ only in numbers are counted together."""
    kinds: Counter[str] = Counter()
    for text, count in details.items():
        kinds[_NUMBER.sub("#", text)] += count
    kind = kinds.most_common(1)[0][0]
    return next(text for text, _ in details.most_common() if _NUMBER.sub("#", text) == kind)


def _name_difference(names: Sequence[str], frames: Sequence[str]) -> str | None:
    """Describe how a name differs from the name of a similar frame; None if none is similar."""
    difference = likely_difference(names[:_MAX_COMPARED], frames[:_MAX_COMPARED])
    return None if difference is None else "{!r} for {!r}: {}".format(*difference)
