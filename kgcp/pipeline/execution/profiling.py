"""The time of one call, divided among its stages."""

from __future__ import annotations

import cProfile
import inspect
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import PurePath
from types import CodeType
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

OTHER = "other steps"
"""Name of the time between stages."""

_PACKAGE = PurePath(__file__).parents[2]


def profiled(
    callers: tuple[Callable[..., object], ...], function: Callable[[_Item], _Result], item: _Item
) -> tuple[_Result, Mapping[str, float]]:
    """Call a function and measure the time of its stages, which slows it down.

    Parameters
    ----------
    callers : tuple of callable
        Functions in modules that only call stages one after the other. Stages are the functions
        that these modules call elsewhere in the package.

    Returns
    -------
    result
        As the function's.
    stages_s : mapping of str to float
        Time of each stage, by its name [s]. The sum is the time of the call.

    Raises
    ------
    Exception
        As the function does.
    """
    files = {inspect.getfile(inspect.unwrap(caller)) for caller in callers}
    profiler = cProfile.Profile()
    begin_s = time.perf_counter()
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
    stages_s[OTHER] = time.perf_counter() - begin_s - sum(stages_s.values())
    return result, dict(stages_s)
