"""Apply a function to many items in a pool of processes, and keep their order."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from kgcp.pipeline.execution.threads import use_one_thread_each

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def ordered_map(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    jobs: int,
    start: Callable[..., None],
    start_arguments: tuple[Any, ...],
    items_per_task: int = 1,
) -> Iterator[_Result]:
    """Yield `function(item)` for every item, in their order.

    Parameters
    ----------
    function : callable
        Must be importable, not a closure.
    jobs : int
        Number of processes; 1: all items are processed in this process.
    start : callable
        Called once per process with `start_arguments`, before any item.
    items_per_task : int
        How many items are sent to a process at once.
    """
    if jobs == 1 or len(items) < 2:
        start(*start_arguments)
        yield from map(function, items)
        return
    use_one_thread_each()
    pool = ProcessPoolExecutor(
        max_workers=min(jobs, len(items)),
        mp_context=multiprocessing.get_context("spawn"),  # forking a threaded parent may deadlock
        initializer=start,
        initargs=start_arguments,
    )
    chunks = (items[i : i + items_per_task] for i in range(0, len(items), items_per_task))
    try:
        futures = [pool.submit(_each, function, chunk) for chunk in chunks]
        for future in futures:
            yield from future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _each(function: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    return [function(item) for item in items]
