"""One thread per process in the numeric libraries: the same bytes, and no waiting for each other.

A sum that several threads share is added up in another order than one thread adds it. So the last
bits of a matrix product depend on the number of threads, and with them, now and then, a digit of a
result. Everything that kgcp computes is therefore computed by one thread; processes are its
parallelism.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from threading import Lock
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread_each() -> None:
    """Keep numeric libraries from starting threads: here if not loaded yet, and in new processes.

    It overrides what the environment says, because results would depend on that.
    """
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = "1"


@contextmanager
def single_threaded() -> Iterator[None]:
    """Keep BLAS, LAPACK and OpenCV on one thread until the block ends, then restore their threads.

    It also holds in a program that has loaded the libraries before it calls kgcp, and for calls
    from several threads, the last of which restores. As a decorator, `@single_threaded()`, it
    serves a function; a generator it would not.
    """
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


class _Limit:
    """The limit of a process, which has one number of threads for all blocks that are at work."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._blocks = 0
        self._undo = ExitStack()

    def enter(self) -> None:
        """Limit the libraries, unless another block has done so."""
        import cv2

        with self._lock:
            if self._blocks == 0:
                with ExitStack() as undo:
                    undo.callback(cv2.setNumThreads, cv2.getNumThreads())
                    cv2.setNumThreads(0)
                    undo.enter_context(_controller().limit(limits=1))
                    self._undo = undo.pop_all()
            self._blocks += 1

    def leave(self) -> None:
        """Restore the libraries, unless another block is still at work."""
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                self._undo.close()


_LIMIT = _Limit()


@cache
def _controller() -> ThreadpoolController:
    """Find the libraries that have threads: 20 ms, once per process."""
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be there to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
