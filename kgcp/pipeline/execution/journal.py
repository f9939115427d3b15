"""The journal of a run: its results so far, kept beside the output until the output is complete.

A journal is a file of lines: a checksum, a key, and the result of one frame. The key covers
everything that the result depends on, so that a result is found again if and only if all of it is
unchanged. The first line states what all results depend on. A run that depends on something else is
refused: otherwise a mistyped option would cost all results so far. Each line is appended as soon as
its result exists. Whatever ends the run leaves at most one broken line, which is ignored.

Records are written as text without loss of precision. They are not pickled, because a journal is
in a folder that may come from anywhere, and a pickle may run code. A database would not help:
SQLite has no checksums, and needs as much code if it must not trust the file (schemas with
triggers, endless trees, rollback journals that name files to delete).
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, partial
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import numpy as np

from kgcp.errors import KgcpError, Reason
from kgcp.io.files.locks import is_at, open_locked
from kgcp.io.files.portable import lock
from kgcp.io.files.safe_read import is_file
from kgcp.measurement import records
from kgcp.measurement.discs.camera_tone import CameraTone
from kgcp.measurement.discs.fit_disc import ProcessingPrior
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoMiss
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.records import Considered, FrameResult, Imaging, Miss, TimeSource, ToneBase
from kgcp.quality.number_text import counted

# All record types of which a result may consist; `records` also imports those of other modules.
_RECORDS: dict[str, type] = {
    name: record
    for name, record in vars(records).items()
    if isinstance(record, type) and is_dataclass(record)
} | {
    record.__name__: record
    for record in (ExifCamera, PhotoDiscs, PhotoMiss, CameraTone, ProcessingPrior)
}
_REASONS: dict[str, Reason] = {reason.value: reason for reason in Reason}
_TONE_BASES: dict[str, ToneBase] = {base.value: base for base in ToneBase}
_TIME_SOURCES: dict[str, TimeSource] = {source.value: source for source in TimeSource}

Result = TypeVar("Result")

_MADE_BY = "made-by"  # the key of the first line
# Shortest interval between two flushes to the disk: a power failure costs at most this time.
_MIN_FLUSH_INTERVAL_S = 1.0
# The interval is also at least this multiple of the last flush's duration, so that flushing takes
# at most 1 % of the time.
_FLUSH_INTERVAL_RATIO = 100
_MAX_LINE_BYTES = 1 << 26  # longer lines are no results
_MAX_SHOWN = 20  # characters of a former value in a message


def to_text(value: object) -> str:
    """Return records, arrays, tuples, mappings and plain values as one line of JSON.

    Floating-point numbers have as many digits as needed to restore them exactly.
    """
    return _ENCODER.encode(value)


def from_text(text: str | bytes, kinds: tuple[type[Result], ...]) -> Result:
    """Return a result of one of these kinds that `to_text` wrote; arrays are of float64.

    Raises
    ------
    ValueError
        If the text is anything else.
    """
    try:
        result = json.loads(text, object_hook=_record)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"no record: {error}") from error
    if not isinstance(result, kinds):
        raise ValueError(f"a {type(result).__name__}, and not a result")
    return result


def fingerprint(*values: object) -> str:
    """Return 32 hexadecimal digits that identify these values."""
    return hashlib.sha256(to_text(values).encode()).hexdigest()[:32]


@cache
def _fields_of(record: type[Any]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(record))


def _plain(value: object) -> object:
    if is_dataclass(value):
        kind: type[Any] = type(value)
        names = _fields_of(kind)  # type: ignore[arg-type] # classes are hashable
        return {"record": kind.__name__, **{name: getattr(value, name) for name in names}}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no text")


_ENCODER = json.JSONEncoder(default=_plain, separators=(",", ":"))


def _record(cells: dict[str, Any]) -> object:
    if "array" in cells:
        return np.array(cells["array"], dtype=np.float64)
    kind = _RECORDS[cells.pop("record")]
    if kind in {Miss, Considered}:
        cells["reason"] = _REASONS[cells["reason"]]
    if kind is FrameResult:
        cells["time_source"] = _TIME_SOURCES[cells["time_source"]]
    if kind is Imaging:
        cells["base"] = _TONE_BASES[cells["base"]]
    if kind is CameraTone:
        cells["tone"] = Tone(cells["tone"])
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in cells.items()})


class Journal(Generic[Result]):
    """Results of frames by their keys, on disk; only one process at a time has it.

    Used in a `with` block, at the end of which, however that is left, all results are kept.

    Parameters
    ----------
    path : Path
        The file; it and its folder are made if need be.
    making : mapping of str
        What results are made with: name to value, which messages show if it is short.
    kinds : tuple of type
        Records that a result may be.
    is_new : bool
        Whether to discard what is there.

    Raises
    ------
    KgcpError
        Here and by all methods, if another process has the journal, or it cannot be read or
        written; here also if its results were made with something else.
    """

    def __init__(
        self,
        path: Path,
        making: Mapping[str, str],
        kinds: tuple[type[Result], ...],
        *,
        is_new: bool,
    ) -> None:
        self._path = path
        self._kinds = kinds
        self._due_s = time.monotonic() + _MIN_FLUSH_INTERVAL_S
        self.seconds = 0.0  # spent here, for the run's record
        self._is_left = False
        with ExitStack() as stack:
            self._writer = stack.enter_context(open_locked(path))
            with self._access():
                self._reader = stack.enter_context(path.open("rb"))
                self._offsets = self._find_lines()
                made_by = self._made_by()
                if is_new or made_by != making:
                    if not is_new:
                        self._refuse_to_lose_results(made_by, making)
                    self._writer.truncate(0)
                    self._reader.seek(0, os.SEEK_END)  # discards the reader's buffer
                    self._offsets.clear()
                    self._append(_MADE_BY, json.dumps(dict(making)))
            stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.flush()
        except KgcpError:
            if kind is None or not issubclass(kind, KgcpError):  # probably the same error again
                raise
        finally:
            self._reader.close()
            self._writer.close()
            if self._is_left:
                with suppress(
                    PermissionError
                ):  # the next run finds all results and deletes the file
                    self._path.unlink(missing_ok=True)

    def __iter__(self) -> Iterator[str]:
        """Yield the keys of all results."""
        return (key for key in self._offsets if key != _MADE_BY)

    def get(self, key: str) -> Result | None:
        """Return the result of a key; None if there is none that can be read."""
        if key not in self._offsets:
            return None
        with self._access(), suppress(ValueError, IndexError):
            return from_text(self._body(key), self._kinds)
        return None

    def read(self, key: str) -> Result:
        """Return the result of a key that exists.

        Raises
        ------
        KgcpError
            If it cannot be read.
        """
        result = self.get(key)
        if result is None:
            raise KgcpError(f"{self._path}: is damaged; start over", option="restart")
        return result

    def add(self, key: str, result: Result) -> None:
        """Add a result: visible to other processes at once, on the disk after about a second."""
        with self._access():
            self._append(key, to_text(result))
        if time.monotonic() >= self._due_s:
            self.flush()

    def flush(self) -> None:
        """Wait until all results are on the disk."""
        began_s = time.monotonic()
        with self._access():
            os.fsync(self._writer.fileno())
        ended_s = time.monotonic()
        self._due_s = ended_s + max(
            _MIN_FLUSH_INTERVAL_S, _FLUSH_INTERVAL_RATIO * (ended_s - began_s)
        )

    def remove(self) -> None:
        """Delete the journal, because the output is complete.

        If the user has deleted it, another run may have a new one of that name, which is kept.
        """
        with self._access():
            if not is_at(self._path, self._writer):
                return
            try:
                self._path.unlink()  # before its lock is released
            except PermissionError:
                if os.name != "nt":
                    raise
                self._is_left = True  # Windows does not delete open files

    def _refuse_to_lose_results(
        self, made_by: Mapping[str, str], making: Mapping[str, str]
    ) -> None:
        """Refuse to empty a journal whose results would be kept if a change were undone."""
        results = sum(1 for _ in self)
        if made_by and results:
            changes = [
                f"{key}{_shown(made_by.get(key))}"
                for key, value in making.items()
                if made_by.get(key) != value
            ]
            raise KgcpError(
                f"{self._path}: has {counted(results, 'result')} of an interrupted run; changed"
                f" since: {', '.join(changes)}; undo this to resume, or start over",
                option="restart",
            )

    def _append(self, key: str, text: str) -> None:
        body = f"{key} {text}\n".encode()
        line = b"%08x %b" % (zlib.crc32(body), body)
        self._offsets[key] = self._writer.seek(0, os.SEEK_END)
        if self._writer.write(line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _body(self, key: str) -> bytes:
        self._reader.seek(self._offsets[key])
        return self._reader.readline(_MAX_LINE_BYTES).split(b" ", 2)[2]

    def _find_lines(self) -> dict[str, int]:
        """Index the valid lines; ignore everything else."""
        offsets: dict[str, int] = {}
        offset = 0
        while line := self._reader.readline(_MAX_LINE_BYTES):
            key = _key_of(line)
            if key is not None:
                offsets[key] = offset
            elif not line.endswith(b"\n"):  # the next line would be appended to it
                self._writer.truncate(offset)
                break
            offset += len(line)
        return offsets

    def _made_by(self) -> Mapping[str, str]:
        made_by = None
        with suppress(LookupError, ValueError, RecursionError):
            made_by = json.loads(self._body(_MADE_BY))
        return made_by if isinstance(made_by, dict) else {}

    @contextmanager
    def _access(self) -> Iterator[None]:
        """Measure the time of a block, and convert its errors to `KgcpError`."""
        began_s = time.monotonic()
        try:
            yield
        except OSError as error:
            raise KgcpError(
                f"{self._path}: {error.strerror}; fix this, and the same command resumes from"
                " what is kept there"
            ) from error
        finally:
            self.seconds += time.monotonic() - began_s


def _shown(value: str | None) -> str:
    """Return the former value of something that has changed, unless it is long, as digests are."""
    return f" (was {value})" if value is not None and len(value) <= _MAX_SHOWN else ""


def results_in(path: Path) -> set[str]:
    """Return the keys of all results in a journal; none if it cannot be read or is being written.

    Opening it as a `Journal` reports such problems.
    """
    if not is_file(path):  # opening a pipe would wait for ever
        return set()
    with suppress(OSError), path.open("rb") as file:
        lock(file.fileno())
        lines = iter(partial(file.readline, _MAX_LINE_BYTES), b"")
        return {key for key in map(_key_of, lines) if key not in {None, _MADE_BY}}
    return set()


def _key_of(line: bytes) -> str | None:
    """Return the key of a line; None if the line is broken."""
    checksum, _, body = line.partition(b" ")
    if checksum != b"%08x" % zlib.crc32(body):
        return None
    return body.partition(b" ")[0].decode(errors="replace")
