"""Where the time of one call goes, by the stages that it strings together."""

from __future__ import annotations

import cProfile
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import CodeType
from typing import Generic, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_PACKAGE = PurePath(__file__).parents[2]
# What these functions call are the stages; they themselves only string them together.
_CONDUCTORS = (_PACKAGE / "pipeline" / "frame_task.py", _PACKAGE / "measurement" / "frame.py")


@dataclass(frozen=True, slots=True)
class Profiled(Generic[_Result]):
    """What a call returned, and the seconds that each stage took, by its name."""

    result: _Result
    stages_s: Mapping[str, float]


def profiled(function: Callable[[_Item], _Result], item: _Item) -> Profiled[_Result]:
    """Call a function and measure its stages, at the price of some time.

    Raises
    ------
    Exception
        As the function does.
    """
    profiler = cProfile.Profile()
    result = profiler.runcall(function, item)
    stages_s: dict[str, float] = defaultdict(float)
    for entry in profiler.getstats():
        if isinstance(entry.code, CodeType) and _path(entry.code) in _CONDUCTORS:
            for call in entry.calls or ():
                stage = _stage(call.code)
                if stage is not None:
                    stages_s[stage] += call.totaltime
    return Profiled(result, dict(stages_s))


def _stage(code: CodeType | str) -> str | None:
    """Name a function of the package that is no conductor: module and function."""
    if not isinstance(code, CodeType):
        return None
    path = _path(code)
    if path in _CONDUCTORS or not path.is_relative_to(_PACKAGE):
        return None
    return ".".join((*path.relative_to(_PACKAGE).with_suffix("").parts, code.co_name))


def _path(code: CodeType) -> PurePath:
    return PurePath(code.co_filename)
