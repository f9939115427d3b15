"""Messages of `kgcp detect` on stderr: progress, interruption, summary."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

import click

from kgcp.quality.number_text import counted

if TYPE_CHECKING:
    from tqdm import tqdm

    from kgcp.pipeline.run_summary import DetectionSummary
    from kgcp.quality.checks.doubt import Doubt

_EXIT_SIGNAL = 128  # plus the signal's number, as shells count
_JSON_PROGRESS_S = 1.0  # between two lines of progress
# Stages of all frames or photographs, and the rounds before them.
_ROUNDS = {"first look": 0, "photographs": 0, "overlay": 1}
_PATIENCE_S = 10.0  # without progress at the start before the wait is explained
_USUAL_WAIT = "the first run compiles its inner loops (a minute or two)"
_SHORTEST_STAGE_S = 0.0005  # shorter ones would print as 0.000


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived: it stops the run as Ctrl-C does."""


class Log:
    """Progress as a bar, as lines of JSON, or not at all.

    Parameters
    ----------
    bar : tqdm
        Disabled where it is not wanted.
    rounds : int
        How often the run goes through all frames: once, or twice if it draws them.
    unit : str
        What is counted.
    wait : str
        Why it takes a while until the first of them is finished.
    """

    def __init__(
        self,
        bar: tqdm[NoReturn],
        *,
        is_quiet: bool,
        as_json: bool,
        rounds: int = 1,
        unit: str = "frame",
        wait: str = _USUAL_WAIT,
    ) -> None:
        self._bar, self._unit, self._wait = bar, unit, wait
        self.is_quiet, self.is_json = is_quiet, as_json
        self._rounds = rounds
        self._due_s = 0.0
        self._stage = ""
        self.done = self.total = 0

    def note(self, text: str) -> None:
        """Print a line, unless errors only are wanted."""
        if self.is_quiet:
            return
        if self.is_json:
            self.event("note", text=text)
        else:
            self._bar.clear()
            click.echo(f"kgcp: {text}", err=True)

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        """Move the bar, whose total is the number of frames in all stages.

        A frame that goes through two rounds counts by half after the first. The progress of a
        second look, which few frames need, is printed beside the bar.
        """
        is_round = stage in _ROUNDS
        frames = self._frames(stage, done, total)
        if stage != self._stage:
            self._stage = stage
            self._bar.set_description(stage, refresh=False)
        self.done, self.total = done, total
        beside: dict[str, object] = {"found": found}
        if not is_round:
            beside[stage.split(maxsplit=1)[0]] = f"{done}/{total}"
        self._bar.set_postfix(beside, refresh=False)
        self._bar.update(frames - self._bar.n)
        is_wanted = self.is_json and not self.is_quiet
        if is_wanted and (time.monotonic() >= self._due_s or done == total):
            self._due_s = time.monotonic() + _JSON_PROGRESS_S
            self.event("progress", stage=stage, done=done, total=total, found=found)

    def _frames(self, stage: str, done: int, total: int) -> int:
        """Return how many frames are finished, counting rounds."""
        before = _ROUNDS.get(stage)
        if before is None:  # between the rounds
            return int(self._bar.n)
        finished = total * min(before, self._rounds - 1) + done
        frames = finished // self._rounds
        if not self._stage:
            self._bar.reset(total)
            self._bar.initial = frames  # what is kept from before is not counted as speed
            self._bar.n = frames
        return frames

    def explain_wait(self) -> None:
        """Explain the wait if no frame is finished yet."""
        if not self.done:
            self.note(f"no {self._unit} is finished yet: {self._wait}")

    def stop(self) -> None:
        """Report how far the run got and how to resume it."""
        self._bar.close()
        if self.is_json:
            self.event("stopped", stage=self._stage, done=self.done, total=self.total)
        else:
            where = f"{self._stage}: " if self._stage else ""
            text = f"{where}{self.done} of {counted(self.total, self._unit)} processed"
            click.echo(
                f"kgcp: stopped; {text}; results kept: repeat the command to resume", err=True
            )

    def event(self, event: str, **values: object) -> None:
        """Print a line of JSON."""
        click.echo(json.dumps({"event": event, **values}), err=True)


@contextmanager
def log_to_stderr(
    *,
    is_quiet: bool,
    as_json: bool,
    rounds: int = 1,
    unit: str = "frame",
    wait: str = _USUAL_WAIT,
) -> Iterator[Log]:
    """Show progress until the block ends, in frames or whatever `unit` says; see `Log`."""
    from tqdm import tqdm

    with tqdm(unit=unit, disable=is_quiet or as_json) as bar:
        log = Log(bar, is_quiet=is_quiet, as_json=as_json, rounds=rounds, unit=unit, wait=wait)
        patience = Timer(_PATIENCE_S, log.explain_wait)
        if sys.stderr.isatty():  # a person may be waiting
            patience.start()
        try:
            yield log
        finally:
            patience.cancel()


@contextmanager
def stopping(log: Log) -> Iterator[None]:
    """Exit, with a line on how to resume, when SIGINT or SIGTERM stops the block."""
    previous = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    except KeyboardInterrupt as stop:
        number = signal.SIGTERM if isinstance(stop, Terminated) else signal.SIGINT
        log.stop()
        click.get_current_context().exit(_EXIT_SIGNAL + number)
    finally:
        signal.signal(signal.SIGTERM, previous)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001 - as signal calls it
    raise Terminated


def report(
    summary: DetectionSummary,
    table: str,
    overlay: Path | None,
    seconds: float,
    log: Log,
    *,
    as_json: bool,
    doubts: Sequence[Doubt] = (),
) -> None:
    """Print the counts of the run; with `as_json` also to stdout, and the doubts about the flight.

    The caller prints the doubts to stderr.
    """
    frames_per_s = (summary.frames - summary.kept) / seconds
    numbers = {**summary.numbers(), "seconds": seconds, "frames_per_s": frames_per_s}
    files = {"table": table}
    if overlay is not None:
        files["overlay"] = str(overlay / "index.html")
    if as_json:
        about = {"doubts": [doubt.summary() for doubt in doubts]}
        click.echo(json.dumps({**numbers, **about, **files}))
    if log.is_quiet:
        return
    if log.is_json:
        log.event("summary", **numbers, **files)
    else:
        _report_in_words(summary, seconds, frames_per_s)
        click.echo(f"wrote {' and '.join(files.values())}", err=True)


def report_stages(summary: DetectionSummary, before_s: float, total_s: float, log: Log) -> None:
    """Print the time per stage, on request even of a quiet run.

    Parameters
    ----------
    before_s : float
        From the start of the program to the start of the work [s].
    total_s : float
        From the start of the program to now [s].
    """
    stages_s = {"loading libraries, checking the flight": before_s, **summary.stages_s}
    if log.is_json:
        log.event("stages", stages_s={**stages_s, "in all": total_s})
        return
    for stage, seconds in stages_s.items():
        if seconds >= _SHORTEST_STAGE_S:
            click.echo(f"{seconds:10.3f} s  {stage}", err=True)
    click.echo(f"{total_s:10.3f} s  in all", err=True)


def _report_in_words(summary: DetectionSummary, seconds: float, frames_per_s: float) -> None:
    counts = ", ".join(
        f"{count} {status.replace('_', ' ')}" for status, count in summary.status.items()
    )
    speed = f" ({frames_per_s:.1f}/s)" if frames_per_s else ""  # all were kept from before
    lines = [f"{counted(summary.frames, 'frame')} in {seconds:.1f} s{speed}: {counts}"]
    lines += [
        f"  {count:6d} {reason}{_about(reason, summary)}"
        for reason, count in summary.reasons.items()
    ]
    if summary.frames_not_chosen:
        lines.append(f"{counted(summary.frames_not_chosen, 'other frame')} not examined (--frames)")
    if summary.guided:
        lines.append(f"{summary.guided} of them measured in the second pass")
    if summary.guide_problem is not None:
        lines.append(f"second pass without reference poses: {summary.guide_problem}")
    if summary.tone_base is not None:
        lines.append(_about_tone(summary))
    if summary.not_drawn:
        lines.append(f"rings not drawn because their frames are missing: {summary.not_drawn}")
    lines += _about_times(summary)
    if summary.frames_without_attitude:
        lines.append(
            f"frames without a camera attitude: {summary.frames_without_attitude}; in these,"
            " a level plate cannot decide between two poses: give [camera] plumb_sd_deg"
        )
    click.echo("\n".join(lines), err=True)


def _about_tone(summary: DetectionSummary) -> str:
    learnt_from = counted(summary.measured_with_tone, "measurement")
    parts = [f"tone curve near {summary.tone_base}, learnt from {learnt_from}"]
    if summary.overruled_by_tone:
        parts.append(f"{summary.overruled_by_tone} alone would suggest another curve")
    if summary.kept_other_tone:
        parts.append(f"{summary.kept_other_tone} kept another curve, which fits far better")
    return "; ".join(parts)


def _about(reason: str, summary: DetectionSummary) -> str:
    """Return the most frequent detail of a reason, and what to do about it."""
    from kgcp.errors import Reason

    remedy = Reason.of(reason).remedy
    if reason not in summary.details:
        return "" if remedy == Reason.OUT_OF_VIEW.remedy else f": {remedy}"
    mostly = "mostly " if summary.reasons[reason] > 1 else ""
    return f": {mostly}{summary.details[reason]}; {remedy}"


def _about_times(summary: DetectionSummary) -> Iterator[str]:
    not_named = summary.frames_not_in_times_file
    if summary.frames_without_time and not not_named:
        yield (
            f"frames without a time: {summary.frames_without_time}; to turn them into KGCPs, name a"
            " times file in flight.toml ([frames] times)"
        )
    if not_named:
        untimed = summary.frames_without_time
        they_have = "it has" if not_named == 1 else "they have"
        if untimed and not_named > 1:
            they_have = f"{untimed} of them {'has' if untimed == 1 else 'have'}"
        which = "no" if untimed else "EXIF's"
        yield (
            f"frames that the times file does not name: {not_named}; {they_have} {which} time:"
            " complete the file"
            + (", or set [frames] exif_fallback = true" if untimed == not_named else "")
        )
    if summary.times_without_frame:
        why = "" if summary.name_difference is None else f" ({summary.name_difference})"
        yield f"times without a frame of that name: {summary.times_without_frame}{why}"
    if summary.exif_times_in_whole_seconds:
        yield (
            f"frames with EXIF times in whole seconds only: {summary.exif_times_in_whole_seconds};"
            " a vehicle moves metres in a second: to turn them into KGCPs, name a times file in"
            " flight.toml ([frames] times)"
        )
