"""Decoded frames kept on the disk for a second look, as far as there is room.

Decoding takes most of the time of a second look; reading grey values back takes a tenth of that or
less. On the disk, all processes find them, and the memory of the workers does not grow.
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

_MAX_BYTES = 1 << 31  # a thousand frames of 2 Mpx
_MAX_DISK_SHARE = 0.25  # of the free space
# A file with one byte per frame, to count them. Listing the folder would take longer and longer.
_COUNT = "count"


@dataclass(frozen=True, slots=True)
class KeptFrames:
    """A folder of decoded frames."""

    folder: Path
    max_bytes: int  # limit for all frames, which have one size in a flight

    def keep(self, frame: str, grey: GreyArray) -> None:
        """Keep the grey values of a frame if there is room; if the disk is full, delete all."""
        path = self._path(frame)
        # written under another name: if this process is killed, no broken frame is found
        unfinished = path.with_suffix(f".{os.getpid()}")
        try:
            with (self.folder / _COUNT).open("ab") as count:  # shared by all processes
                count.write(b".")
                count.flush()
                number = count.tell()
            if number * grey.nbytes <= self.max_bytes:
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
    """Remove the folder of this run, or of one that was killed."""
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def kept_frames(folder: Path) -> Iterator[KeptFrames | None]:
    """Provide a folder for decoded frames until the block ends; None if it cannot be created.

    Frames left by a run that was killed are removed first, since they may have changed.
    """
    remove_kept_frames(folder)
    try:
        folder.mkdir()
        room = int(_MAX_DISK_SHARE * shutil.disk_usage(folder).free)
        kept = KeptFrames(folder.absolute(), min(_MAX_BYTES, room))
    except OSError:
        kept = None
    try:
        yield kept
    finally:
        remove_kept_frames(folder)
