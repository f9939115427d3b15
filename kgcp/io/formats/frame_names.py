"""Why names in a file are not those of the frames: letter case, extension or folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

_Key = Callable[[PurePosixPath], str]

# What two names have in common where they differ in one thing only; the commonest slips first.
_DIFFERENCES: tuple[tuple[str, _Key], ...] = (
    ("upper and lower case differ", lambda path: str(path).lower()),
    ("the extension differs", lambda path: str(path.with_suffix(""))),
    ("the folder differs", lambda path: path.name),
    ("folder and extension differ", lambda path: path.stem),
    ("folder, extension or letter case differ", lambda path: path.stem.lower()),
)


def likely_difference(names: Sequence[str], frames: Sequence[str]) -> tuple[str, str, str] | None:
    """Return what distinguishes names from those of the frames they probably mean.

    Parameters
    ----------
    names : sequence of str
        None of which is a frame's.
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
