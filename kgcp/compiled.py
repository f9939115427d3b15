"""Loops over pixels, compiled to machine code when they are first used.

The compiled code is kept beside the source, or in the user's cache folder where that cannot be
written, and found again by later runs. It is found by the source file of the function alone: so
compiled functions call only compiled functions of their own file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_FUSED = {"contract"}  # a · b + c in one step, with one rounding, where the processor has it
_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; division by zero gives inf or NaN as in numpy."""
    return cast("_Function", numba.njit(cache=True, error_model="numpy", fastmath=_FUSED)(function))


def inlined(function: _Function) -> _Function:
    """Compile a function into those that call it, which leave out what they do not use."""
    made = numba.njit(cache=True, error_model="numpy", fastmath=_FUSED, forceinline=True)(function)
    return cast("_Function", made)
