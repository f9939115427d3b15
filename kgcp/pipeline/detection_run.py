"""First and second look at all frames of a flight, by a pool of workers, with a journal of results.

Results of an interrupted run are taken from the journal. The key of a result covers everything that
it depends on: the frame's file and prior knowledge, and for a second look the predictions. The
journal itself checks what all results depend on.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from kgcp.errors import KgcpError, Reason
from kgcp.geometry.camera import Response
from kgcp.georef.neighbouring_normals import Place, preferences_of_neighbours
from kgcp.io.images.remote import stamps_of
from kgcp.measurement.adjustment.smoothing import with_smoothing
from kgcp.measurement.guided import Prediction
from kgcp.measurement.other_pose import with_preference
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.records import (
    FrameResult,
    Miss,
    Outcome,
    ToneBase,
    is_unreadable,
)
from kgcp.pipeline.execution.executor import WorkerPool
from kgcp.pipeline.execution.journal import Journal, fingerprint, results_in
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.frame_task import (
    DetectionJob,
    FrameInput,
    GuidedInput,
    completed,
    examine_frame,
    examine_frame_again,
    lost_frame,
    result_without_second_look,
    shows_negative,
)
from kgcp.pipeline.guidance import FrameTracks
from kgcp.quality.learnt_imaging import (
    LearntImaging,
    base_if_distances_agree,
    clearly_agreed_base,
    learn_imaging,
    over_base,
)
from kgcp.quality.number_text import counted
from kgcp.settings import Method

_REASONS = {TaskFailure.CRASHED: Reason.WORKER_DIED, TaskFailure.TIMED_OUT: Reason.TIMED_OUT}

_FIRST_BATCH = 8  # frames that are measured with both bases of an unknown tone curve
# Frames whose results are completed together, which takes a tenth of the time per frame.
_CHUNK_FRAMES = 256
_NEGATIVE_FRAMES = 12  # frames that are tried with black and white swapped

_Result = TypeVar("_Result")


class ProgressListener(Protocol):
    """Receiver of notes and progress."""

    def note(self, text: str) -> None:
        """Receive one line of information for the user."""

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        """Receive the progress of a stage; `found` is the number of frames with a target so far."""


class FirstSizes:
    """Check of the first frames' sizes: if all are wrong and equal, the camera is the wrong one.

    Parameters
    ----------
    frames : int
        Number of frames of the flight. A short flight is examined to its end.
    """

    FRAMES = 20

    def __init__(self, frames: int) -> None:
        self._seen = 0 if frames > self.FRAMES else self.FRAMES
        self._details: set[str] = set()
        # wrong size of all first `FRAMES` frames, and that of the camera; None: not all are wrong
        self.wrong: str | None = None

    def add(self, result: FrameResult) -> None:
        """Add the result of the next frame."""
        if self._seen >= self.FRAMES:
            return
        self._seen += 1
        first = result.outcomes[0]
        is_wrong = isinstance(first, Miss) and first.reason is Reason.WRONG_SIZE
        self._details.add(first.detail if is_wrong and isinstance(first, Miss) else "")
        if len(self._details) > 1 or "" in self._details:
            self._seen = self.FRAMES
        elif self._seen == self.FRAMES:
            (self.wrong,) = self._details


def refuse_to_lose_results(journal: Path, frames: Sequence[str]) -> None:
    """Refuse a run whose end deletes an interrupted run's results of other frames.

    Parameters
    ----------
    journal : Path
        File of the journal, which need not exist.
    frames : sequence of str
        Frames of the flight that are not to be examined.

    Raises
    ------
    KgcpError
        If there are results of such frames.
    """
    names = {_name_of(key) for key in results_in(journal)}
    others = sum(_first_name(frame) in names for frame in frames)
    if others:
        raise KgcpError(
            f"{journal}: has an interrupted run's results of {counted(others, 'other frame')},"
            " which would be lost; finish that run, or name another folder with --out",
            option="frames",
        )


class DetectionRun:
    """The looks at all frames, and their results so far.

    Parameters
    ----------
    journal : Journal
        Keeps the results, and may have some of an interrupted run.
    """

    def __init__(
        self,
        job: DetectionJob,
        inputs: Sequence[FrameInput],
        journal: Journal[FrameResult],
        pool: WorkerPool,
        listener: ProgressListener,
    ) -> None:
        self._job, self._inputs, self._journal = job, inputs, journal
        self._pool, self._listener = pool, listener
        self._rows = {frame_input.frame: row for row, frame_input in enumerate(inputs)}
        stamps = [*stamps_of(job.frames_folder, [frame_input.frame for frame_input in inputs])]
        self.frame_sizes = {  # bytes of the file of every frame; None: missing
            frame_input.frame: None if stamp is None else stamp[0]
            for frame_input, stamp in zip(inputs, stamps, strict=True)
        }
        self._stamps = stamps
        self._keys = [""] * len(inputs)  # of the last results; empty: not examined yet
        self._stage, self._done, self._total = "", 0, 0
        # of the results so far
        self.tracks = FrameTracks(job.all_targets, [frame_input.frame for frame_input in inputs])
        self.kept = 0  # frames whose first look was in the journal
        self.learnt: LearntImaging | None = None  # result of `learn`
        self._deciding_frames: set[str] = set()  # frames that decided the base of the tone curve
        self._preferences: Mapping[Place, float] = {}

    def first_pass(self) -> None:
        """Examine all frames that are not in the journal.

        Raises
        ------
        KgcpError
            If the first frames all have the same size, but not the camera's, or frames disappear.
        """
        sizes = FirstSizes(len(self._inputs))
        has_begun = False
        for number, rows in enumerate(self._batches()):
            if number:
                self._settle_tone_base()
            todo = [row for row in rows if not self._is_kept(row, sizes)]
            if todo and not has_begun:
                self._report_kept_results()
                self._begin("first look", self.kept, len(self._inputs))
                has_begun = True
            elif has_begun:  # results of the journal after frames that were not in it
                self._advance(len(rows) - len(todo))
            self._look_at(todo, sizes)
        if not has_begun:
            self._report_kept_results()
            self._begin("first look", self.kept, len(self._inputs))

    def _batches(self) -> list[list[int]]:
        """Return the rows in batches; after each, the base of the tone curve may be decided.

        Each batch is evenly distributed over all frames and as large as all batches before it. So
        the decision depends neither on the number of workers nor on interruptions.
        """
        count, camera = len(self._inputs), self._job.camera
        settings = self._job.settings
        may_decide = settings.is_learning and settings.method is Method.MODEL
        if not may_decide or camera.response is not Response.UNKNOWN:
            return [[*range(count)]]
        spread = sorted(range(count), key=_bits_reversed)
        batches, first, last = [], 0, _FIRST_BATCH
        while first < count:
            batches.append(sorted(spread[first:last]))
            first, last = last, 2 * last
        return batches

    def _is_kept(self, row: int, sizes: FirstSizes) -> bool:
        """Take the result of a frame from the journal; tell whether it was there."""
        key = self._key(row, self._job.tone_base)
        self._keys[row] = key
        kept = self._journal.get(key)
        if kept is None:
            return False
        self.tracks.add(row, kept)
        sizes.add(kept)
        self.kept += 1
        return True

    def _look_at(self, todo: Sequence[int], sizes: FirstSizes) -> None:
        inputs = (self._inputs[row] for row in todo)
        with closing(self._pool.map(partial(examine_frame, self._job), inputs)) as results:
            for frame_input, result in results:
                row = self._rows[frame_input.frame]
                if isinstance(result, TaskFailure):
                    self._keys[row] = _key_of_lost(self._keys[row])
                    self._keep(row, lost_frame(self._job, frame_input, _REASONS[result]))
                else:
                    self._require_frame(result)
                    self._keep(row, result)
                    sizes.add(result)
                    if sizes.wrong is not None:
                        self._journal.remove()  # neither other frames nor another camera need it
                        raise KgcpError(
                            f"{self._job.frames_folder}: the first {FirstSizes.FRAMES} frames"
                            f" looked at are all {sizes.wrong}; {Reason.WRONG_SIZE.remedy}"
                        )

    def _settle_tone_base(self) -> None:
        """Decide the tone base for the remaining frames, if the results so far allow it."""
        if self._job.tone_base is None:
            results = [*self._results_so_far()]
            base = clearly_agreed_base(results) or base_if_distances_agree(results)
            self._job = replace(self._job, tone_base=base)
            self._deciding_frames = {result.frame for result in results}

    def _results_so_far(self) -> Iterator[FrameResult]:
        return (self._journal.read(key) for key in self._keys if key)

    def guided_pass(
        self,
        predictions: Mapping[int, Mapping[str, Prediction]],
        plain: Mapping[int, Mapping[str, PlainPrediction]],
    ) -> None:
        """Look again at the readable frames in which a missing target must be visible.

        Parameters
        ----------
        predictions, plain : mapping of mappings
            Predictions of coded and of plain targets, by row and target.
        """
        visible: dict[int, dict[str, Prediction]] = {}
        for row, by_target in predictions.items():
            if self.tracks.is_readable[row]:
                camera = self._job.camera
                in_frame = {
                    name: prediction
                    for name, prediction in by_target.items()
                    if prediction.is_visible(camera)
                }
                if in_frame:
                    visible[row] = in_frame
        keys = {}
        for row in sorted({*visible, *plain}):
            predicted = visible.get(row, {}), plain.get(row, {})
            keys[row] = f"again-{fingerprint(self._keys[row], *predicted, self._job.tone_base)}"
        todo = []
        for row, key in keys.items():
            kept = self._journal.get(key)
            if kept is None:
                todo.append(row)
            else:
                self._keys[row] = key
                self.tracks.add(row, kept)
        self._begin("second look", len(keys) - len(todo), len(keys))
        guided_inputs = (
            GuidedInput(
                self._inputs[row],
                self._journal.read(self._keys[row]),
                visible.get(row, {}),
                plain.get(row, {}),
            )
            for row in todo
        )
        with closing(
            self._pool.map(partial(examine_frame_again, self._job), guided_inputs)
        ) as results:
            for guided_input, result in results:
                row = self._rows[guided_input.input.frame]
                if isinstance(result, TaskFailure):
                    self._keys[row] = _key_of_lost(keys[row])
                    self._keep(row, result_without_second_look(guided_input, _REASONS[result]))
                else:
                    self._keys[row] = keys[row]
                    self._keep(row, result)

    def require_unchanged_frames(self) -> None:
        """Stop if files have changed since the run began: results may be of either state.

        A frame that was measured and then deleted does no harm.

        Raises
        ------
        KgcpError
            Naming one of them.
        """
        frames = [frame_input.frame for frame_input in self._inputs]
        now = stamps_of(self._job.frames_folder, frames)
        changed = [
            frame
            for frame, then, stamp in zip(frames, self._stamps, now, strict=True)
            if stamp is not None and stamp != then
        ]
        if changed:
            others = counted(len(changed) - 1, "other frame")
            so_have = "" if len(changed) == 1 else f", and so have {others}"
            raise KgcpError(
                f"{self._job.frames_folder / changed[0]}: has changed during the run{so_have};"
                " once all frames are in place, repeat the command, which resumes"
            )

    def is_negative(self) -> bool:
        """Tell whether a target is measured in some frames if black and white are swapped."""
        readable = np.flatnonzero(self.tracks.is_readable)
        sample = readable[:: math.ceil(len(readable) / _NEGATIVE_FRAMES) or 1]
        inputs = (self._inputs[row] for row in sample)
        with closing(self._pool.map(partial(shows_negative, self._job), inputs)) as results:
            return any(result is True for _, result in results)

    def learn(self) -> None:
        """Learn from all frames together; `results` are updated by it from now on.

        All frames together tell which known curve the tone curve is close to. The frames before and
        after a frame tell which of its two normals is more likely. Settings may turn off either.
        For the choice of normals, the learnt smoothing along contours is ignored: it changes
        normals by far less than they differ between neighbouring frames.
        """
        results = [*self._results_so_far()]
        if self._job.settings.is_learning:
            base = self._job.tone_base
            deciding_frames = None if base is None else self._deciding_frames
            self.learnt = learn_imaging(results, base, deciding_frames)
        if self._job.settings.is_guided:
            self._preferences = preferences_of_neighbours(
                replace(result, outcomes=tuple(map(self._over_common_base, result.outcomes)))
                for result in results
            )

    def results(self) -> Iterator[FrameResult]:
        """Yield the latest result of every frame, in the frames' order."""
        for first in range(0, len(self._keys), _CHUNK_FRAMES):
            yield from self._completed_as_learnt(self._keys[first : first + _CHUNK_FRAMES])

    def _completed_as_learnt(self, keys: Sequence[str]) -> Iterator[FrameResult]:
        """Yield results updated by what is learnt, including what depends on changed poses."""
        results = [*map(self._journal.read, keys)]
        learnt = [
            self._as_learnt(result.frame, outcome)
            for result in results
            for outcome in result.outcomes
        ]
        before = (outcome for result in results for outcome in result.outcomes)
        changed = [i for i, outcome in enumerate(before) if outcome is not learnt[i]]
        done = completed(self._job, [learnt[i] for i in changed])
        for i, outcome in zip(changed, done, strict=True):
            learnt[i] = outcome
        outcomes = iter(learnt)
        for result in results:
            yield replace(result, outcomes=tuple(islice(outcomes, len(result.outcomes))))

    def _as_learnt(self, frame: str, outcome: Outcome) -> Outcome:
        """Return an outcome by what is learnt; the same one if that is nothing."""
        learnt = self._over_common_base(outcome)
        if isinstance(learnt, Miss):
            return learnt
        if self.learnt is not None:
            learnt = with_smoothing(self._job.camera, learnt, self.learnt.smoothing)
        preference = self._preferences.get((frame, learnt.target, learnt.instance))
        if preference is None:
            return learnt
        return with_preference(self._job.camera, learnt, preference)

    def _over_common_base(self, outcome: Outcome) -> Outcome:
        """Return an outcome over the base of the tone curve that all agree on, if they do."""
        if self.learnt is None or self.learnt.base is None or isinstance(outcome, Miss):
            return outcome
        return over_base(outcome, self.learnt.base)

    def map_results(
        self, function: Callable[[FrameResult], _Result]
    ) -> Iterator[tuple[int, FrameResult, _Result | TaskFailure]]:
        """Yield what workers make of the last result of every frame, with its row, as it comes."""
        self._begin("overlay", 0, len(self._keys))
        with closing(self._pool.map(function, self.results())) as made:
            for result, one in made:
                self._advance()
                yield self._rows[result.frame], result, one

    def _keep(self, row: int, result: FrameResult) -> None:
        self._journal.add(self._keys[row], result)
        self.tracks.add(row, result)
        self._advance()

    def _begin(self, stage: str, done: int, total: int) -> None:
        self._stage, self._done, self._total = stage, done, total
        if total:
            self._listener.progress(stage, done, total, self.tracks.found)

    def _advance(self, frames: int = 1) -> None:
        self._done += frames
        self._listener.progress(self._stage, self._done, self._total, self.tracks.found)

    def _require_frame(self, result: FrameResult) -> None:
        """Stop if a frame cannot be read because it has disappeared, perhaps with its disk."""
        path = self._job.frames_folder / result.frame
        if not isinstance(path, Path):  # an object store raises its own errors
            return
        if any(map(is_unreadable, result.outcomes)) and not os.path.lexists(path):
            raise KgcpError(
                f"{path}: has disappeared; once the frames are back, repeat the command, which"
                " resumes"
            )

    def _report_kept_results(self) -> None:
        in_journal = set(self._journal)
        names = {_name_of(key) for key in in_journal}
        is_settled = self._job.tone_base is not None
        bases = (self._job.tone_base,) if is_settled else (None, *ToneBase)
        later = changed = 0
        for row, key in enumerate(self._keys):
            if key in in_journal:
                continue
            keys = [key] if key else [self._key(row, base) for base in bases]
            if not in_journal.isdisjoint(keys):
                later += 1
            elif _name_of(keys[0]) in names:
                changed += 1
        if self.kept or later or changed:
            up_to = "up to " if later and not is_settled else ""
            self._listener.note(
                f"resuming an interrupted run: results of {up_to}{self.kept + later} of"
                f" {len(self._keys)} frames are kept, {changed} have changed since"
            )

    def _key(self, row: int, tone_base: ToneBase | None) -> str:
        """Return the key of a first look."""
        frame_input, file = self._inputs[row], self._stamps[row]
        known = (
            frame_input.time_s,
            frame_input.may_use_exif_time,
            frame_input.priors,
            frame_input.plain,
            frame_input.coded,
            tone_base,
        )
        return f"{_first_name(frame_input.frame)}-{fingerprint(file, *known)[:16]}"


def _bits_reversed(number: int) -> int:
    """Return a number's 32 bits in reverse order: multiples of large powers of 2 come first."""
    return int(f"{number:032b}"[::-1], 2)


def _first_name(frame: str) -> str:
    """Return the part of a first look's key that identifies a frame."""
    return f"first-{fingerprint(frame)[:16]}"


def _name_of(key: str) -> str:
    """Return the part of a first look's key that identifies the frame."""
    return key.rpartition("-")[0]


def _key_of_lost(key: str) -> str:
    """Return a key that no other run can find, so that it tries again."""
    return f"lost-{os.getpid()}-{time.time_ns()}-{key}"
