"""Frame times in the frames' names, as machine-vision recorders write them.

Names of drones and phones hold local time in whole seconds: too coarse for a moving target.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

from kgcp.errors import SettingError
from kgcp.io.files.time_text import parse_time

# Unix seconds with a fraction, or Unix milli-, micro- or nanoseconds.
_SECONDS = re.compile(r"(?<!\d)(1\d{9})(?:\.(\d{1,9})|_(\d{6}|\d{9}))(?!\d)")
_PARTS = re.compile(r"(?<!\d)(1\d{9})(\d{3}|\d{6}|\d{9})(?!\d)")
_ISO = re.compile(
    r"(?<!\d)(\d{4})-?(\d\d)-?(\d\d)[T_ -]?(\d\d)[:.-]?(\d\d)[:.-]?(\d\d)[.,_-]?(\d{1,9})Z"
)


def times_of_names(frames: Sequence[str]) -> dict[str, float] | None:
    """Return the times in the frames' names, Unix UTC [s]; None unless each has its own.

    Parameters
    ----------
    frames : sequence of str
        Paths below the frames folder.
    """
    if _are_counted(frames):
        return None
    times: dict[str, float] = {}
    for frame in frames:
        time_s = _time_s(PurePosixPath(frame).stem)
        if time_s is None:
            return None
        times[frame] = time_s
    return times if len(set(times.values())) == len(times) else None


def _are_counted(frames: Sequence[str]) -> bool:
    """Whether six digits after the seconds count frames: 1781597705_000012, 1781597705_000013."""
    matches = [_SECONDS.search(PurePosixPath(frame).stem) for frame in frames]
    digits = [match[3] for match in matches if match is not None and match[3] is not None]
    numbers = sorted(map(int, digits))
    if len(numbers) < max(2, len(frames)):
        return False
    return numbers == [*range(numbers[0], numbers[0] + len(numbers))]


def _time_s(stem: str) -> float | None:
    if match := _ISO.search(stem):
        year, month, day, hour, minute, second, fraction = match.groups()
        text = f"{year}-{month}-{day}T{hour}:{minute}:{second}.{fraction[:6]}Z"
    elif match := _SECONDS.search(stem):
        text = f"{match[1]}.{match[2] or match[3]}"
    elif match := _PARTS.search(stem):
        text = f"{match[1]}.{match[2]}"
    else:
        return None
    try:
        return parse_time(text)
    except SettingError:
        return None
