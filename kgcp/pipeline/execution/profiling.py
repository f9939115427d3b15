"""Time of one call by the stages that it strings together."""

from __future__ import annotations

import cProfile
import inspect
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import CodeType
from typing import Generic, TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_PACKAGE = PurePath(__file__).parents[2]


@dataclass(frozen=True, slots=True)
class Profiled(Generic[_Result]):
    """Result of a call, and the seconds that each stage took, by its name."""

    result: _Result
    stages_s: Mapping[str, float]


def profiled(
    callers: tuple[Callable[..., object], ...], function: Callable[[_Item], _Result], item: _Item
) -> Profiled[_Result]:
    """Call a function and measure its stages, at the price of some time.

    Parameters
    ----------
    callers : tuple of callable
        Functions that only string stages together, as do all others of their modules: what these
        modules call elsewhere in the package are the stages.

    Raises
    ------
    Exception
        As the function does.
    """
    files = {inspect.getfile(inspect.unwrap(caller)) for caller in callers}
    profiler = cProfile.Profile()
    result = profiler.runcall(function, item)
    stages_s: dict[str, float] = defaultdict(float)
    for entry in profiler.getstats():
        if isinstance(entry.code, CodeType) and entry.code.co_filename in files:
            for call in entry.calls or ():
                if isinstance(call.code, CodeType) and call.code.co_filename not in files:
                    path = PurePath(call.code.co_filename)
                    if path.is_relative_to(_PACKAGE):
                        module = path.relative_to(_PACKAGE).with_suffix("").parts
                        stages_s[".".join((*module, call.code.co_name))] += call.totaltime
    return Profiled(result, dict(stages_s))
