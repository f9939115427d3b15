"""Loops over pixels, compiled to machine code when they are first used.

The compiled code is kept beside the source, or in the user's cache folder where that cannot be
written, and found again by later runs. It is found by the source file of the function alone: so
compiled functions call only compiled functions of their own file.

A function is handed to numba at its first call. A process that compiles nothing does not load
numba, and one that uses few functions does not ask for each of the others where its compiled code
may be kept: together half a second of a process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import update_wrapper
from typing import Any, TypeVar, cast

import numpy as np

from kgcp.errors import KgcpError

_Function = TypeVar("_Function", bound=Callable[..., Any])

_FOR_READING = 0, 3, 1  # LLVM's prefetch: to read, into the nearest cache, of data
# So many calls by Python take as long as loading numba and its tables: 0.5 s.
_CALLS_BEFORE_COMPILING = 100_000


class _Compilable:
    """A function that is compiled, or found compiled, when it is first called.

    Parameters
    ----------
    options
        Of `numba.njit`, beyond those of all functions.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401 - numba's
        self._function, self._options = function, options
        self._dispatcher: Callable[..., Any] | None = None
        update_wrapper(self, function)

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the compiled function, and compile it if this is the first call."""
        dispatcher = self._dispatcher or self.dispatcher()
        return dispatcher(*args)

    def interpreted(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the function as Python runs it, with numpy's division by zero."""
        with np.errstate(all="ignore"):
            return self._function(*args)

    def dispatcher(self) -> Callable[..., Any]:
        """Return numba's dispatcher of the function, which replaces this one in its module.

        Those that the function calls come first: numba looks for them under their names.

        Raises
        ------
        KgcpError
            If there is no folder in which compiled code could be kept.
        """
        if self._dispatcher is None:
            import numba

            function = self._function
            for name in function.__code__.co_names:
                called = function.__globals__.get(name)
                if isinstance(called, _Compilable) and called is not self:
                    function.__globals__[name] = called.dispatcher()
            try:
                made = numba.njit(cache=True, error_model="numpy", **self._options)(function)
            except RuntimeError as error:  # numba's own, where no folder is left
                raise KgcpError(
                    f"compiled code cannot be stored in any folder ({error}); set the environment"
                    " variable NUMBA_CACHE_DIR to a folder that can be written"
                ) from error
            function.__globals__[function.__name__] = self._dispatcher = made
        return self._dispatcher


class _CompiledIfOften(_Compilable):
    """A function that Python runs until numba is loaded, or there are many calls."""

    calls_left = _CALLS_BEFORE_COMPILING  # of all such functions together

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the function as Python runs it, or compiled once there were many calls."""
        if _CompiledIfOften.calls_left > 0 and "numba" not in sys.modules:
            _CompiledIfOften.calls_left -= 1
            return self.interpreted(*args)
        return super().__call__(*args)


class _Hint(_Compilable):
    """A function (array, index) that does nothing but ask the processor to load that entry.

    Compiled functions of any file may call it, since it changes no result.
    """

    def dispatcher(self) -> Callable[..., Any]:
        """Return the function itself, which numba now knows as the processor's instruction."""
        if self._dispatcher is None:
            from llvmlite import ir
            from numba import types
            from numba.extending import lower_builtin, type_callable

            number, pointer = ir.IntType(32), ir.IntType(8).as_pointer()

            # numba hands over objects of its own, for which it has no annotations
            def returned(_: Any) -> Any:  # noqa: ANN401
                return lambda _array, _index: types.void

            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ANN401
                """Emit the instruction."""
                data = context.make_array(signature.args[0])(context, builder, values[0]).data
                place = builder.bitcast(builder.gep(data, [values[1]]), pointer)
                kind = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
                hint = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
                builder.call(hint, [place, *map(number, _FOR_READING)])
                return context.get_dummy_value()

            type_callable(self._function)(returned)
            lower_builtin(self._function, types.Array, types.Integer)(generate)
            self._dispatcher = self._function
        return self._dispatcher


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; division by zero gives inf or NaN as in numpy."""
    return cast("_Function", _Compilable(function))


def compiled_if_often(function: _Function) -> _Function:
    """Compile as `compiled`, unless the whole process calls such functions a few times only.

    Sums, differences, products and quotients alone: of these, Python makes the same bits.
    """
    return cast("_Function", _CompiledIfOften(function))


def interpreted(function: _Function) -> _Function:
    """Return a compiled function as Python runs it, for calls too few to load numba for."""
    return cast("_Function", cast("_Compilable", function).interpreted)


def summed(function: _Function) -> _Function:
    """Compile as `compiled`; sums may be reordered so that vector units take several terms."""
    return cast("_Function", _Compilable(function, fastmath={"contract", "reassoc"}))


def inlined(function: _Function) -> _Function:
    """Compile a function into those that call it, which leave out what they do not use."""
    return cast("_Function", _Compilable(function, forceinline=True))


def fused(function: _Function) -> _Function:
    """Compile as `inlined`; a · b + c may be one step with one rounding, if the processor has it.

    Where, is up to the compiler. So what calls such a function is to be called by Python alone: of
    a function that others call there may be two versions, and which one they get depends on what a
    process has compiled itself and what it has found compiled.
    """
    return cast("_Function", _Compilable(function, forceinline=True, fastmath={"contract"}))


@_Hint
def prefetch(array: np.ndarray[Any, Any], index: int) -> None:
    """Have the processor load an entry of a contiguous array into its cache, without waiting.

    For loops over places whose distances it cannot foresee. The index need not be in the array.
    """
