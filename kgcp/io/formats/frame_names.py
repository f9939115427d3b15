"""Match names in a file with those of the frames, and explain why others do not match."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

from kgcp.io.files.csv_columns import frame_name
from kgcp.io.files.sniff import ForeignFile

_Key = Callable[[PurePosixPath], str]

# Differences of names, and what two names then have in common; the commonest slips first.
_DIFFERENCES: tuple[tuple[str, _Key], ...] = (
    ("upper and lower case differ", lambda path: str(path).lower()),
    ("the extension differs", lambda path: str(path.with_suffix(""))),
    ("the folder differs", lambda path: path.name),
    ("folder and extension differ", lambda path: path.stem),
    ("folder, extension or letter case differ", lambda path: path.stem.lower()),
)


def likely_difference(names: Sequence[str], frames: Sequence[str]) -> tuple[str, str, str] | None:
    """Return how names differ from those of the frames that they probably mean.

    Parameters
    ----------
    names : sequence of str
        None of them is a frame's.
    frames : sequence of str
        Paths below the frames folder.

    Returns
    -------
    tuple of str, or None
        A name, the frame that it probably means, and in words how they differ; None if no name
        resembles a frame's.
    """
    for words, key in _DIFFERENCES:
        by_key = {key(_path(frame)): frame for frame in reversed(frames)}
        for name in names:
            frame = by_key.get(key(_path(name)))
            if frame is not None:
                has_none = words.startswith("the extension") and not _path(name).suffix
                return name, frame, "the extension is missing" if has_none else words
    return None


def _path(name: str) -> PurePosixPath:
    return PurePosixPath(name or ".")


def frames_of(file: ForeignFile, names: Sequence[str], frames: Sequence[str]) -> tuple[str, ...]:
    """Return the frames of these names.

    Other programs name images by their path, the end of it, the file name, or the file name without
    extension. Letter case counts. A name that fits no frame is kept.

    Parameters
    ----------
    frames : sequence of str
        Of the flight, relative to the frames folder; they may repeat.

    Raises
    ------
    KgcpError
        If a name fits several frames, or two names fit one frame.
    """
    owners: dict[str, str] = {}
    by_name: dict[str, list[str]] = defaultdict(list)
    all_frames = set(frames)
    for frame in sorted(all_frames):
        path = PurePosixPath(frame)
        for key in {path.name, path.stem}:
            by_name[key].append(frame)
    for name in names:
        frame = _frame_of(file, frame_name(name), all_frames, by_name)
        if frame in owners:
            raise file.error(
                f"images {owners[frame]!r} and {name!r} are both {frame!r}", "keep one of them"
            )
        owners[frame] = name
    return tuple(owners)


def _frame_of(file: ForeignFile, name: str, frames: set[str], by_name: dict[str, list[str]]) -> str:
    if name in frames:
        return name
    candidates = by_name.get(PurePosixPath(name).name, [])
    if len(candidates) > 1:  # folders may distinguish them
        candidates = [frame for frame in candidates if _ends_alike(name, frame)] or candidates
    if len(candidates) > 1:
        raise file.error(
            f"image {name!r} may be {candidates[0]!r} or {candidates[1]!r}",
            "rename the frames so that their names differ",
        )
    return candidates[0] if candidates else name


def _ends_alike(name: str, frame: str) -> bool:
    """Whether the longer of two paths ends in the shorter, with extension or without."""
    parts = PurePosixPath(name).parts
    for path in (PurePosixPath(frame), PurePosixPath(frame).with_suffix("")):
        shared = min(len(parts), len(path.parts))
        if shared > 1 and parts[-shared:] == path.parts[-shared:]:
            return True
    return False
