"""Ordered work on many items by a pool of processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_one_core_each() -> None:
    """Tell numeric libraries not to start threads, here if not loaded yet and in new processes.

    The processes are the parallelism: threads inside them only wait for each other.
    """
    for variable in _THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")


def ordered_map(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    jobs: int,
    start: Callable[..., None],
    start_arguments: tuple[Any, ...],
    items_per_task: int = 1,
) -> Iterator[Result]:
    """Yield `function(item)` for every item, in their order.

    Parameters
    ----------
    function : callable
        Importable, not a closure.
    items : sequence
    jobs : int
        Processes; 1 works in this one.
    start : callable
        Called once per process with `start_arguments`, before any item.
    items_per_task : int
        How many items travel to a process at once.
    """
    if jobs == 1 or len(items) < 2:
        start(*start_arguments)
        yield from map(function, items)
        return
    use_one_core_each()
    pool = ProcessPoolExecutor(
        max_workers=min(jobs, len(items)),
        mp_context=multiprocessing.get_context("spawn"),  # forking a threaded parent may deadlock
        initializer=start,
        initargs=start_arguments,
    )
    try:
        with _interrupts_ignored():  # by the workers, who inherit it: the parent stops them
            results = pool.map(function, items, chunksize=items_per_task)
        yield from results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
