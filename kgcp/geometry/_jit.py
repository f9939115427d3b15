"""Loops over pixels, compiled to machine code when they are first used.

The compiled code is kept beside the source, or in the user's cache folder where that cannot be
written, and found again by later runs. It is found by the source file of the function alone: so
compiled functions call only compiled functions of their own file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; division by zero gives inf or NaN as in numpy."""
    return cast("_Function", numba.njit(cache=True, error_model="numpy")(function))


def summed(function: _Function) -> _Function:
    """Compile as `compiled`; sums may be reordered so that vector units take several terms."""
    made = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})(function)
    return cast("_Function", made)


def inlined(function: _Function) -> _Function:
    """Compile a function into those that call it, which leave out what they do not use."""
    made = numba.njit(cache=True, error_model="numpy", forceinline=True)(function)
    return cast("_Function", made)


def fused(function: _Function) -> _Function:
    """Compile as `inlined`; a · b + c may be one step with one rounding, if the processor has it.

    Where, is up to the compiler. So what calls such a function is to be called by Python alone: of
    a function that others call there may be two versions, and which one they get depends on what a
    process has compiled itself and what it has found compiled.
    """
    made = numba.njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
    return cast("_Function", made(function))
