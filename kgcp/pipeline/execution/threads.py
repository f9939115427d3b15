"""One thread per process in the numeric libraries, so that results do not depend on their number.

Several threads add up a sum in another order than a single one. So the last bits of a matrix
product depend on the number of threads, and occasionally a digit of a result. Therefore each
process of kgcp computes with one thread; kgcp uses several processes instead. They also do not
compete for cores.
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
    """Limit numeric libraries to one thread: those not yet loaded here, and in new processes.

    This overrides the environment, because results would depend on it.
    """
    for variable in _THREAD_VARIABLES:
        os.environ[variable] = "1"


@contextmanager
def single_threaded() -> Iterator[None]:
    """Keep BLAS, LAPACK and OpenCV on one thread until the block ends, then restore their threads.

    It also works in programs that have loaded the libraries before they call kgcp. Several threads
    may call it; the last one restores. The decorator `@single_threaded()` works for functions, but
    not for generators.
    """
    _LIMIT.enter()
    try:
        yield
    finally:
        _LIMIT.leave()


class _Limit:
    """The limit of this process, shared by all blocks that are running."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._blocks = 0
        self._undo = ExitStack()

    def enter(self) -> None:
        """Limit the libraries, unless another running block has done so."""
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
        """Restore the libraries, unless another block is still running."""
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
