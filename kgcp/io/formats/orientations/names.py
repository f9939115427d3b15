"""Matching of other programs' image names with the frames of the flight."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import PurePosixPath

from kgcp.io.files.sniff import ForeignFile


def frames_of(file: ForeignFile, names: Sequence[str], frames: Sequence[str]) -> tuple[str, ...]:
    """Return the frames of these names.

    Other programs call images by their path, the end of it, the file's name alone, or that without
    its extension; letters keep their case. A name that fits no frame stays as it is.

    Parameters
    ----------
    frames : sequence of str
        Of the flight, relative to the frames folder; each may stand there repeatedly.

    Raises
    ------
    KgcpError
        If a name fits several frames, or two names the same.
    """
    owners: dict[str, str] = {}
    by_name: dict[str, list[str]] = defaultdict(list)
    known = set(frames)
    for frame in sorted(known):
        path = PurePosixPath(frame)
        for key in {path.name, path.stem}:
            by_name[key].append(frame)
    for name in names:
        frame = _frame_of(file, name.replace("\\", "/"), known, by_name)
        if frame in owners:
            raise file.error(
                f"images {owners[frame]!r} and {name!r} are both {frame!r}", "keep one of them"
            )
        owners[frame] = name
    return tuple(owners)


def _frame_of(file: ForeignFile, name: str, frames: set[str], by_name: dict[str, list[str]]) -> str:
    if name in frames:
        return name
    fitting = by_name.get(PurePosixPath(name).name, [])
    if len(fitting) > 1:  # folders may tell them apart
        fitting = [frame for frame in fitting if _ends_alike(name, frame)] or fitting
    if len(fitting) > 1:
        raise file.error(
            f"image {name!r} may be {fitting[0]!r} or {fitting[1]!r}",
            "rename the frames so that their names differ",
        )
    return fitting[0] if fitting else name


def _ends_alike(name: str, frame: str) -> bool:
    """Whether the longer of two paths ends in the shorter, with extension or without."""
    parts = PurePosixPath(name).parts
    for path in (PurePosixPath(frame), PurePosixPath(frame).with_suffix("")):
        shared = min(len(parts), len(path.parts))
        if shared > 1 and parts[-shared:] == path.parts[-shared:]:
            return True
    return False
