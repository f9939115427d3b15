"""Choice of frames by patterns of their names."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence

from kgcp.errors import KgcpError

_SHOWN_FRAMES = 3


def matching_frames(frames: Sequence[str], patterns: Sequence[str]) -> list[str]:
    """Return the frames that match one of the patterns, in the given order; all without patterns.

    Parameters
    ----------
    frames : sequence of str
        Paths below the frames folder.
    patterns : sequence of str
        Of such paths, in the notation of `fnmatch`: `*` also matches `/`, and letter case counts.
        Backslashes may separate folders.

    Raises
    ------
    KgcpError
        If a pattern matches no frame. The message names some frames.
    """
    if not patterns:
        return list(frames)
    for pattern in patterns:
        if not any(is_chosen(frame, (pattern,)) for frame in frames):
            examples = ", ".join(frames[:_SHOWN_FRAMES])
            raise KgcpError(
                f"{pattern!r} matches none of {len(frames)} frames ({examples}, …); give a pattern"
                ' of their paths below the frames folder, such as "*_00??.JPG"',
                option="frames",
            )
    return [frame for frame in frames if is_chosen(frame, patterns)]


def is_chosen(frame: str, patterns: Sequence[str]) -> bool:
    """Return whether a frame matches one of the patterns of `matching_frames`."""
    return any(
        fnmatch.fnmatchcase(frame, form)
        for pattern in patterns
        for form in (pattern, pattern.replace("\\", "/"))
    )
