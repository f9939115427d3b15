"""All frames of a flight looked at, once and again, by a pool of workers and into a journal.

What an interrupted run has left in the journal is not done again. A key of the journal says all
that a result depends on: the frame's file and what is known of it, and for a second look also what
is expected. What all results depend on is the journal's own business.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

from kgcp.errors import KgcpError, Reason
from kgcp.io.images.remote import stamps_of
from kgcp.measurement.guided import Expectation
from kgcp.measurement.records import FrameResult, is_unreadable
from kgcp.pipeline.execution.executor import Crew
from kgcp.pipeline.execution.journal import Journal, fingerprint
from kgcp.pipeline.execution.resilient_map import Loss
from kgcp.pipeline.frame_task import (
    FrameNote,
    FrameTask,
    SecondLook,
    examine_frame,
    examine_frame_again,
    kept_frame,
    lost_frame,
)
from kgcp.pipeline.guidance import Sightings

_REASONS = {Loss.DIED: Reason.WORKER_DIED, Loss.LATE: Reason.TIMED_OUT}

_Result = TypeVar("_Result")


class Watcher(Protocol):
    """Who is told how the work goes."""

    def note(self, text: str) -> None:
        """Hear of something that the user should know, in one line."""

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        """Hear how many frames of a stage are done, of how many, and how many show a target."""


class Looks:
    """The results of all frames, as far as they are there.

    Parameters
    ----------
    journal : Journal
        Where results are kept, and may be.

    Attributes
    ----------
    sightings : Sightings
        Of the results so far.
    kept : int
        Frames whose first look the journal had.
    """

    def __init__(
        self,
        task: FrameTask,
        notes: Sequence[FrameNote],
        journal: Journal,
        crew: Crew,
        watcher: Watcher,
    ) -> None:
        self._task, self._notes, self._journal = task, notes, journal
        self._crew, self._watcher = crew, watcher
        self._rows = {note.frame: row for row, note in enumerate(notes)}
        stamps = stamps_of(task.frames_folder, [note.frame for note in notes])
        self._keys = [_key(note, stamp) for note, stamp in zip(notes, stamps, strict=True)]
        self._stage, self._done, self._total = "", 0, 0
        self.sightings = Sightings(task.targets, [note.frame for note in notes])
        self.kept = 0

    def look(self) -> None:
        """Look at all frames that the journal has not."""
        todo = []
        for row, key in enumerate(self._keys):
            kept = self._journal.get(key)
            if kept is None:
                todo.append(row)
            else:
                self.sightings.add(row, kept)
        self.kept = len(self._keys) - len(todo)
        self._tell_what_is_kept(todo)
        self._begin("first look", self.kept, len(self._keys))
        notes = (self._notes[row] for row in todo)
        with closing(self._crew.map(partial(examine_frame, self._task), notes)) as results:
            for note, result in results:
                row = self._rows[note.frame]
                if isinstance(result, Loss):
                    self._keys[row] = _key_of_lost(self._keys[row])
                    self._keep(row, lost_frame(self._task, note, _REASONS[result]))
                else:
                    self._require_frame(result)
                    self._keep(row, result)

    def look_again(self, expected: Mapping[int, Mapping[str, Expectation]]) -> None:
        """Look again at the readable frames in which a missing target must be visible.

        Parameters
        ----------
        expected : mapping of mappings
            By row and target.
        """
        visible: dict[int, dict[str, Expectation]] = {}
        for row, by_target in expected.items():
            if self.sightings.is_readable[row]:
                camera = self._task.camera
                named = {name: one for name, one in by_target.items() if one.is_visible(camera)}
                if named:
                    visible[row] = named
        keys = {
            row: f"again-{fingerprint(self._keys[row], named)}" for row, named in visible.items()
        }
        todo = []
        for row, key in keys.items():
            kept = self._journal.get(key)
            if kept is None:
                todo.append(row)
            else:
                self._keys[row] = key
                self.sightings.add(row, kept)
        self._begin("second look", len(keys) - len(todo), len(keys))
        looks = (self._second_look(row, visible[row]) for row in todo)
        with closing(self._crew.map(partial(examine_frame_again, self._task), looks)) as results:
            for look, result in results:
                row = self._rows[look.note.frame]
                if isinstance(result, Loss):
                    self._keys[row] = _key_of_lost(keys[row])
                    self._keep(row, kept_frame(look, _REASONS[result]))
                else:
                    self._keys[row] = keys[row]
                    self._keep(row, result)

    def results(self) -> Iterator[FrameResult]:
        """Yield the last result of every frame, in the frames' order."""
        return map(self._journal.read, self._keys)

    def through(
        self, function: Callable[[FrameResult], _Result]
    ) -> Iterator[tuple[int, FrameResult, _Result | Loss]]:
        """Yield what workers make of the last result of every frame, with its row, as it comes."""
        self._begin("overlay", 0, len(self._keys))
        with closing(self._crew.map(function, self.results())) as made:
            for result, one in made:
                self._advance()
                yield self._rows[result.frame], result, one

    def _second_look(self, row: int, expected: Mapping[str, Expectation]) -> SecondLook:
        return SecondLook(self._notes[row], self._journal.read(self._keys[row]), expected)

    def _keep(self, row: int, result: FrameResult) -> None:
        self._journal.add(self._keys[row], result)
        self.sightings.add(row, result)
        self._advance()

    def _begin(self, stage: str, done: int, total: int) -> None:
        self._stage, self._done, self._total = stage, done, total
        if total:
            self._watcher.progress(stage, done, total, self.sightings.found)

    def _advance(self) -> None:
        self._done += 1
        self._watcher.progress(self._stage, self._done, self._total, self.sightings.found)

    def _require_frame(self, result: FrameResult) -> None:
        """Stop where frames cannot be read because they are gone, with the disk they were on."""
        path = self._task.frames_folder / result.frame
        if not isinstance(path, Path):  # a store says itself why it cannot be read
            return
        if any(map(is_unreadable, result.outcomes)) and not os.path.lexists(path):
            raise KgcpError(
                f"{path}: has vanished; when the frames are there again, the same command goes on"
            )

    def _tell_what_is_kept(self, todo: Sequence[int]) -> None:
        if self._journal.changes:
            changes = ", ".join(self._journal.changes)
            self._watcher.note(
                f"starting anew, not with the interrupted run's results: {changes} changed since"
            )
        kept = {_name_of(key) for key in self._journal}
        changed = sum(_name_of(self._keys[row]) in kept for row in todo)
        if self.kept or changed:
            self._watcher.note(
                f"going on with an interrupted run: results of {self.kept} of"
                f" {len(self._keys)} frames are kept, {changed} have changed since"
            )


def _key(note: FrameNote, file: tuple[int, int] | None) -> str:
    name = fingerprint(note.frame)[:16]
    return f"first-{name}-{fingerprint(file, note.time_s, note.prior)[:16]}"


def _name_of(key: str) -> str:
    """Return the part of a first look's key that says which frame it is."""
    return key.rpartition("-")[0]


def _key_of_lost(key: str) -> str:
    """Return a key that no other run finds: it will try again."""
    return f"lost-{os.getpid()}-{time.time_ns()}-{key}"
