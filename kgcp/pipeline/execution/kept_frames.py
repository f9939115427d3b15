"""Decoded frames kept on the disk between two looks at them, as far as there is room.

Decoding is most of what a second look costs. To read grey values back takes a tenth of it or less,
and whatever process looks again finds them, while the memory of the workers stays as it is.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.geometry.arrays import GreyArray
from kgcp.io.files.portable import replace

_MOST_BYTES = 1 << 31  # a thousand frames of 2 Mpx
_SHARE_OF_DISK = 0.25  # of what is free
_COUNT = "count"  # a file with a byte for each frame: to list the folder takes ever longer


@dataclass(frozen=True, slots=True)
class KeptFrames:
    """A folder of decoded frames."""

    folder: Path
    most_bytes: int  # all frames of a flight are of one size

    def keep(self, frame: str, grey: GreyArray) -> None:
        """Keep the grey values of a frame if there is room; a full disk gets back what was kept."""
        path = self._path(frame)
        unfinished = path.with_suffix(f".{os.getpid()}")  # whatever ends this process: not the name
        try:
            with (self.folder / _COUNT).open("ab") as count:  # for all processes
                count.write(b".")
                count.flush()
                number = count.tell()
            if number * grey.nbytes <= self.most_bytes:
                with unfinished.open("wb") as stream:
                    np.lib.format.write_array(stream, grey, allow_pickle=False)
                replace(unfinished, path)
        except OSError:
            remove_kept_frames(self.folder)

    def find(self, frame: str) -> GreyArray | None:
        """Return the grey values of a frame; None if they were not kept."""
        try:
            with self._path(frame).open("rb") as stream:
                return np.lib.format.read_array(stream, allow_pickle=False)
        except (OSError, ValueError):
            return None

    def _path(self, frame: str) -> Path:
        return self.folder / hashlib.sha256(frame.encode()).hexdigest()[:32]


def remove_kept_frames(folder: Path) -> None:
    """Remove the folder, of this run or of one that was killed."""
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def kept_frames(folder: Path) -> Iterator[KeptFrames | None]:
    """Have a folder for decoded frames until the block ends; None if it cannot be made.

    What a run that was killed has left there goes first: its frames may have changed since.
    """
    remove_kept_frames(folder)
    try:
        folder.mkdir()
        room = int(_SHARE_OF_DISK * shutil.disk_usage(folder).free)
        kept = KeptFrames(folder.absolute(), min(_MOST_BYTES, room))
    except OSError:
        kept = None
    try:
        yield kept
    finally:
        remove_kept_frames(folder)
