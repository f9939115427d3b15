"""One thread per process in the numeric libraries: the same bytes, and no waiting for each other.

A sum that several threads share is added up in another order than one thread adds it. So the last
bits of a matrix product depend on the number of threads, and with them, now and then, a digit of a
result. Everything that kgcp computes is therefore computed by one thread; processes are its
parallelism.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
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

    It also holds in a program that has loaded the libraries before it calls kgcp. As a decorator,
    `@single_threaded()`, it serves a function; a generator it would not.
    """
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(0)
    try:
        with _controller().limit(limits=1):
            yield
    finally:
        cv2.setNumThreads(threads)


@cache
def _controller() -> ThreadpoolController:
    """Find the libraries that have threads: 20 ms, once per process."""
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be there to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
