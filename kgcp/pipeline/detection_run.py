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

    def progress(self, done: int, total: int, found: int) -> None:
        """Hear how many looks are done, of how many, and how many frames show a target."""


class Looks:
    """The results of all frames, as far as they are there.

    Parameters
    ----------
    task : FrameTask
    notes : sequence of FrameNote
    journal : Journal
        Where results are kept, and may be.
    crew : Crew
    watcher : Watcher

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
        self._done, self._total = 0, len(notes)
        self.sightings = Sightings(task.targets, [note.frame for note in notes])
        self.kept = sum(key in journal for key in self._keys)

    def look(self) -> None:
        """Look at all frames that the journal has not."""
        self._tell_what_is_kept()
        todo = []
        for row, key in enumerate(self._keys):
            if key in self._journal:
                self.sightings.add(row, self._journal.read(key))
            else:
                todo.append(self._notes[row])
        self._advance(self.kept)
        with closing(self._crew.map(partial(examine_frame, self._task), todo)) as results:
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
        visible = {
            row: {name: one for name, one in here.items() if one.is_visible(self._task.camera)}
            for row, here in expected.items()
            if self.sightings.is_readable[row]
        }
        keys = {
            row: f"again-{fingerprint(self._keys[row], here)}"
            for row, here in visible.items()
            if here
        }
        todo = [row for row, key in keys.items() if key not in self._journal]
        looks = (self._second_look(row, visible[row]) for row in todo)
        self._total += len(keys)
        for row in keys.keys() - set(todo):
            self._keys[row] = keys[row]
            self.sightings.add(row, self._journal.read(keys[row]))
        self._advance(len(keys) - len(todo))
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
        self._total += len(self._keys)
        with closing(self._crew.map(function, self.results())) as made:
            for result, one in made:
                self._advance(1)
                yield self._rows[result.frame], result, one

    def _second_look(self, row: int, expected: Mapping[str, Expectation]) -> SecondLook:
        return SecondLook(self._notes[row], self._journal.read(self._keys[row]), expected)

    def _keep(self, row: int, result: FrameResult) -> None:
        self._journal.add(self._keys[row], result)
        self.sightings.add(row, result)
        self._advance(1)

    def _advance(self, looks: int) -> None:
        self._done += looks
        self._watcher.progress(self._done, self._total, self.sightings.found)

    def _require_frame(self, result: FrameResult) -> None:
        """Stop where frames cannot be read because they are gone, with the disk they were on."""
        path = self._task.frames_folder / result.frame
        if not isinstance(path, Path):  # of a store, whoever cannot read has told why
            return
        if any(map(is_unreadable, result.outcomes)) and not os.path.lexists(path):
            raise KgcpError(
                f"{path}: has vanished; when the frames are there again, the same command goes on"
            )

    def _tell_what_is_kept(self) -> None:
        if self._journal.changes:
            changes = ", ".join(self._journal.changes)
            self._watcher.note(
                f"starting anew, not with the interrupted run's results: {changes} changed since"
            )
        seen = {_name_of(key) for key in self._journal}
        changed = sum(key not in self._journal and _name_of(key) in seen for key in self._keys)
        if self.kept or changed:
            self._watcher.note(
                f"going on with an interrupted run: {self.kept} of {len(self._keys)} frames are"
                f" done, {changed} have changed since (--restart ignores it)"
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
