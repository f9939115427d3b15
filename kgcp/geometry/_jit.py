"""Decorators that compile loops over pixels to machine code (numba), at the first call.

numba caches the compiled code beside the source file, or in the user's cache folder if that cannot
be written. Later runs load it from there. The cache notices changes of the function's own source
file only. Therefore a compiled function may call compiled functions of its own file, but no others.

Functions are handed to numba at their first call, not at import. A process that calls none of them
does not load numba. A process that calls a few does not look up cache files for all the others.
Together this saves half a second per process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import update_wrapper
from typing import Any, TypeVar, cast

import numpy as np

from kgcp.errors import KgcpError

_Function = TypeVar("_Function", bound=Callable[..., Any])

_PREFETCH_ARGUMENTS = 0, 3, 1  # of llvm.prefetch: read access, keep in all cache levels, data cache
# Interpreting this many calls takes as long as loading numba and the cached code: 0.5 s.
_CALLS_BEFORE_COMPILING = 100_000


class _CompiledCodeFiles:
    """numba's cache of one function, with the methods that numba calls.

    numba does not flush the files to the disk, so a power failure can leave them empty. It would
    then raise whatever reading them raises, in every later run.

    Raises
    ------
    KgcpError
        By all methods, if a file cannot be written.
    """

    def __init__(self, files: Any) -> None:  # noqa: ANN401 - numba's
        self._files = files
        self.cache_path: str = files.cache_path

    def load_overload(self, sig: object, target_context: object) -> Any:  # noqa: ANN401 - numba's
        """Return the compiled code for these types; None if there is none, or if it is damaged."""
        try:
            return self._files.load_overload(sig, target_context)
        except Exception:  # a damaged pickle can raise any
            with self._writing():
                self._files.flush()
            return None

    def save_overload(self, sig: object, data: object) -> None:
        """Store compiled code for these types."""
        with self._writing():
            self._files.save_overload(sig, data)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise KgcpError(
                f"{self.cache_path}: compiled code cannot be stored ({error.strerror}); make room,"
                " or set the environment variable NUMBA_CACHE_DIR to another folder"
            ) from error


class _Compilable:
    """A function that is compiled, or loaded from the cache, when it is first called.

    Parameters
    ----------
    options
        For `numba.njit`, in addition to those that all functions have.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401 - numba's
        self._function, self._options = function, options
        self._dispatcher: Callable[..., Any] | None = None
        update_wrapper(self, function)

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the compiled function; compile it first if necessary."""
        dispatcher = self._dispatcher or self.dispatcher()
        return dispatcher(*args)

    def interpreted(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the plain Python function; division by zero gives inf or NaN without a warning."""
        with np.errstate(all="ignore"):
            return self._function(*args)

    def dispatcher(self) -> Callable[..., Any]:
        """Return numba's dispatcher, and put it in this object's place in the function's module.

        The compilable functions that this one calls are replaced first, because numba looks them up
        by name in the module.

        Raises
        ------
        KgcpError
            If there is no writable folder for the compiled code.
        """
        if self._dispatcher is None:
            import numba
            from numba.core.caching import FunctionCache

            function = self._function
            for name in function.__code__.co_names:
                called = function.__globals__.get(name)
                if isinstance(called, _Compilable) and called is not self:
                    function.__globals__[name] = called.dispatcher()
            made = numba.njit(error_model="numpy", **self._options)(function)
            try:
                made._cache = _CompiledCodeFiles(FunctionCache(function))  # as `cache=True` does
            except RuntimeError as error:  # numba found no writable cache folder
                raise KgcpError(
                    f"compiled code cannot be stored in any folder ({error}); set the environment"
                    " variable NUMBA_CACHE_DIR to a folder that can be written"
                ) from error
            function.__globals__[function.__name__] = self._dispatcher = made
        return self._dispatcher


class _CompiledIfOften(_Compilable):
    """A function that is interpreted until numba is loaded anyway, or until it is called often."""

    calls_left = _CALLS_BEFORE_COMPILING  # shared by all such functions

    def __call__(self, *args: Any) -> Any:  # noqa: ANN401 - those of the function
        """Call the interpreted or the compiled function."""
        if _CompiledIfOften.calls_left > 0 and "numba" not in sys.modules:
            _CompiledIfOften.calls_left -= 1
            return self.interpreted(*args)
        return super().__call__(*args)


class _PrefetchIntrinsic(_Compilable):
    """A function (array, index) that numba translates to the processor's prefetch instruction.

    Compiled functions of any file may call it, because it does not change results: a stale cache
    does no harm.
    """

    def dispatcher(self) -> Callable[..., Any]:
        """Register the function as an intrinsic with numba, and return it unchanged."""
        if self._dispatcher is None:
            from llvmlite import ir
            from numba import types
            from numba.extending import lower_builtin, type_callable

            number, pointer = ir.IntType(32), ir.IntType(8).as_pointer()

            # numba passes objects of its own, which have no annotations
            def returned(_: Any) -> Any:  # noqa: ANN401
                return lambda _array, _index: types.void

            def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ANN401
                """Emit the instruction."""
                data = context.make_array(signature.args[0])(context, builder, values[0]).data
                place = builder.bitcast(builder.gep(data, [values[1]]), pointer)
                kind = ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
                hint = builder.module.declare_intrinsic("llvm.prefetch", [pointer], kind)
                builder.call(hint, [place, *map(number, _PREFETCH_ARGUMENTS)])
                return context.get_dummy_value()

            type_callable(self._function)(returned)
            lower_builtin(self._function, types.Array, types.Integer)(generate)
            self._dispatcher = self._function
        return self._dispatcher


def compiled(function: _Function) -> _Function:
    """Compile a function of numbers and arrays; division by zero gives inf or NaN, as in numpy."""
    return cast("_Function", _Compilable(function))


def compiled_if_often(function: _Function) -> _Function:
    """Compile as `compiled`, but only if the process makes many calls of such functions.

    Only for functions that add, subtract, multiply and divide: interpreted and compiled code then
    give the same bits.
    """
    return cast("_Function", _CompiledIfOften(function))


def interpreted(function: _Function) -> _Function:
    """Return the plain Python function of a compiled one, for calls too few to load numba."""
    return cast("_Function", cast("_Compilable", function).interpreted)


def reassociated(function: _Function) -> _Function:
    """Compile as `compiled`, and let the compiler reorder sums to vectorise them."""
    return cast("_Function", _Compilable(function, fastmath={"contract", "reassoc"}))


def inlined(function: _Function) -> _Function:
    """Compile a function into its callers, where results that are not used cost nothing."""
    return cast("_Function", _Compilable(function, forceinline=True))


def fused(function: _Function) -> _Function:
    """Compile as `inlined`; a · b + c may become a fused multiply-add, which rounds only once.

    The compiler decides where it fuses. So a function that calls a fused one must be called from
    Python only. If compiled functions called it, there could be two versions of it that round
    differently. Which one they get would depend on what the process compiled itself and what it
    loaded from the cache.
    """
    return cast("_Function", _Compilable(function, forceinline=True, fastmath={"contract"}))


@_PrefetchIntrinsic
def prefetch(array: np.ndarray[Any, Any], index: int) -> None:
    """Start to load an entry of a contiguous array into the cache, without waiting for it.

    For loops whose memory accesses the processor cannot predict. The index may be out of range.
    """
