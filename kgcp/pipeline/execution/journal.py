"""What a run has done so far, kept beside its output until the output is there.

A journal is a folder of part files, each complete or absent, and `journal.json`, which says by what
its results were made. A line of a part is a checksum, a key, and the result of one frame. The key
says all that the result depends on: a result is found again if, and only if, all of it is the same.
Records are written as text without the loss of a bit. Not by pickling: a journal lies in a folder
that may come from anybody, and a pickle may run code.
"""

from __future__ import annotations

import errno
import hashlib
import json
import shutil
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from kgcp.errors import KgcpError, Reason
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.io.files.atomic import whole_file
from kgcp.io.files.safe_read import is_file
from kgcp.measurement.records import (
    Alternative,
    Appearance,
    CommonUncertainty,
    Considered,
    ExposureSettings,
    FrameResult,
    Miss,
    Observation,
    Uncertainty,
)

_RECORDS: dict[str, type] = {
    each.__name__: each
    for each in (
        *(FrameResult, ExposureSettings, Observation, Miss, Considered, Pose, Ellipse),
        *(Appearance, Uncertainty, CommonUncertainty, Alternative),
    )
}
_REASONS: dict[str, Reason] = {reason.value: reason for reason in Reason}

_HEADER = "journal.json"
_SHORTEST_S = 1.0  # between two parts
_PAUSES = 100  # times as long as the last part took to write, at least: 1 % of the time
_LARGEST_PART = 1000  # results, all of which are in memory until it is written
_CHECKSUM = 8  # hexadecimal digits
_OFFSET_BITS = 40
_DIGITS = 7  # of the parts' numbers
_LONGEST_LINE = 1 << 26  # bytes: what is longer is no result


def to_text(value: object) -> str:
    """Return records, arrays, tuples, mappings and plain values as one line of JSON.

    Floating-point numbers have as many digits as tell them from all others.
    """
    return json.dumps(value, default=_plain, separators=(",", ":"))


def from_text(text: str | bytes) -> FrameResult:
    """Return the result of a frame that `to_text` wrote; arrays are of float64, and in C order.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    try:
        result = json.loads(text, object_hook=_record)
    except (KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"no record: {error}") from error
    if not isinstance(result, FrameResult):
        raise ValueError(f"a {type(result).__name__}, and not the result of a frame")
    return result


def fingerprint(*values: object) -> str:
    """Return 32 hexadecimal digits that tell such values from all others."""
    return hashlib.sha256(to_text(values).encode()).hexdigest()[:32]


def _plain(value: object) -> object:
    if is_dataclass(value):
        cells = {field.name: getattr(value, field.name) for field in fields(value)}
        return {"record": type(value).__name__, **cells}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist()}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no text")


def _record(cells: dict[str, Any]) -> object:
    if "array" in cells:
        return np.array(cells["array"], dtype=np.float64)
    kind = _RECORDS[cells.pop("record")]
    if kind in {Miss, Considered}:
        cells["reason"] = _REASONS[cells["reason"]]
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in cells.items()})


class Journal:
    """Results of frames by their keys, on disk.

    Used in a `with` block, at the end of which, however that is left, all results are kept.

    Parameters
    ----------
    folder : Path
        Made if need be. What was made otherwise is deleted.
    making : mapping of str
        By what results are made: name, in words, to value.
    is_new : bool
        Whether to delete whatever is there.

    Attributes
    ----------
    changes : tuple of str
        Names of what is not as it was in the journal that was found, which was deleted for it.
    seconds : float
        Spent here, for the run's record.

    Raises
    ------
    KgcpError
        Here and by all methods, if the folder cannot be read or written.
    """

    def __init__(self, folder: Path, making: Mapping[str, str], *, is_new: bool) -> None:
        self._folder = folder
        self._places: dict[str, int] = {}  # by key: part and offset in one number, to be small
        self._parts = 0
        self._waiting: dict[str, bytes] = {}
        self._read_last: tuple[int, bytes] = (0, b"")  # the part's number, and all of it
        self._due_s = time.monotonic() + _SHORTEST_S
        self.seconds = 0.0
        try:
            if folder.is_symlink():
                raise OSError(errno.EMLINK, "is a link; delete it")
            found = None if is_new else _read_header(folder)
            self.changes = tuple(
                name for name, value in making.items() if found and found.get(name) != value
            )
            if found is None or self.changes:
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                with whole_file(folder / _HEADER) as temporary:
                    temporary.write_text(json.dumps(dict(making), indent=1), encoding="utf-8")
            self._find_results()
        except OSError as error:
            raise self._unusable(error) from error

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
            if kind is None or not issubclass(kind, KgcpError):  # of which this is the echo
                raise

    def __contains__(self, key: str) -> bool:
        return key in self._places or key in self._waiting

    def __iter__(self) -> Iterator[str]:
        yield from self._places
        yield from self._waiting

    def add(self, key: str, result: FrameResult) -> None:
        """Keep a result, on disk within a second or so."""
        began_s = time.monotonic()
        body = f"{key} {to_text(result)}\n".encode()
        self._waiting[key] = f"{zlib.crc32(body):0{_CHECKSUM}x} ".encode() + body
        self.seconds += time.monotonic() - began_s
        if len(self._waiting) >= _LARGEST_PART or time.monotonic() >= self._due_s:
            self.flush()

    def flush(self) -> None:
        """Put on disk what is not there yet."""
        if not self._waiting:
            return
        began_s = time.monotonic()
        number = self._parts + 1
        try:
            with whole_file(self._part(number)) as temporary:
                temporary.write_bytes(b"".join(self._waiting.values()))
        except OSError as error:
            raise self._unusable(error) from error
        offset = 0
        for key, line in self._waiting.items():
            self._places[key] = number << _OFFSET_BITS | offset
            offset += len(line)
        self._parts = number
        self._waiting.clear()
        took_s = time.monotonic() - began_s
        self.seconds += took_s
        self._due_s = time.monotonic() + max(_SHORTEST_S, _PAUSES * took_s)

    def read(self, key: str) -> FrameResult:
        """Return the result of a key that is in the journal."""
        if key in self._waiting:
            self.flush()
        began_s = time.monotonic()
        number, offset = divmod(self._places[key], 1 << _OFFSET_BITS)
        path = self._part(number)
        try:
            if number != self._read_last[0]:  # results are read in nearly the order of the parts
                self._read_last = number, path.read_bytes()
            part = self._read_last[1]
            result = from_text(part[offset : part.index(b"\n", offset)].split(b" ", 2)[2])
        except OSError as error:
            raise self._unusable(error) from error
        except (ValueError, IndexError) as error:
            raise KgcpError(f"{path}: is damaged ({error}); run again with --restart") from error
        self.seconds += time.monotonic() - began_s
        return result

    def remove(self) -> None:
        """Delete it: the output is there."""
        shutil.rmtree(self._folder, ignore_errors=True)
        self._places.clear()
        self._waiting.clear()
        self._read_last = (0, b"")

    def _find_results(self) -> None:
        """Index the whole lines of all parts; what else is there counts as not done."""
        for path in filter(is_file, sorted(self._folder.glob(f"part-{'[0-9]' * _DIGITS}.txt"))):
            number = int(path.stem.partition("-")[2])
            self._parts = max(self._parts, number)
            offset = 0
            with path.open("rb") as stream:
                while line := stream.readline(_LONGEST_LINE):
                    body = line[_CHECKSUM + 1 :]
                    if line[:_CHECKSUM] == f"{zlib.crc32(body):0{_CHECKSUM}x}".encode():
                        key = body.partition(b" ")[0].decode(errors="replace")
                        self._places[key] = number << _OFFSET_BITS | offset
                    offset += len(line)

    def _part(self, number: int) -> Path:
        return self._folder / f"part-{number:0{_DIGITS}d}.txt"

    def _unusable(self, error: OSError) -> KgcpError:
        return KgcpError(
            f"{self._folder}: {error.strerror}; when that is put right, the same command goes on"
            " from what is kept there"
        )


def _read_header(folder: Path) -> Mapping[str, str] | None:
    """Return by what the results in a journal were made; None if there is none."""
    if not is_file(folder / _HEADER):
        return None
    try:
        header = json.loads((folder / _HEADER).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError, RecursionError):
        return None
    return header if isinstance(header, dict) else None
