"""Work on many items by a pool of processes: in order, or in spite of processes that die."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    ALL_COMPLETED,
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from enum import Enum, auto
from itertools import islice
from typing import Any, TypeVar

from kgcp.errors import KgcpError
from kgcp.pipeline.execution.signals import stops_held
from kgcp.pipeline.execution.threads import use_one_thread_each

Item = TypeVar("Item")
Result = TypeVar("Result")

_STARTS = 3  # of a process, before it counts as impossible
_TURN_S = 0.2  # of waiting, after which a signal is heeded
_TRIES = 2  # of an item alone: the first death may have come before its turn


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    use_one_thread_each()
    pool = ProcessPoolExecutor(
        max_workers=min(jobs, len(items)),
        mp_context=multiprocessing.get_context("spawn"),  # forking a threaded parent may deadlock
        initializer=start,
        initargs=start_arguments,
    )
    chunks = (items[i : i + items_per_task] for i in range(0, len(items), items_per_task))
    try:
        with stops_held():
            futures = [pool.submit(_each, function, chunk) for chunk in chunks]
        for future in futures:
            yield from _settled(future).result()
    finally:
        with stops_held():
            pool.shutdown(wait=True, cancel_futures=True)


def _each(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    return [function(item) for item in items]


class Loss(Enum):
    """Why an item has no result."""

    DIED = auto()  # the process that worked on it ended
    LATE = auto()  # it took longer than it may


class Overdue(BrokenExecutor):
    """A worker has ended because its call took longer than it may."""


class Inline(Executor):
    """Works in this process, at once: its end is the end of all. Signals wait for a call's end."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Return the result of a call as a future that is done."""
        future: Future[Any] = Future()
        with stops_held():
            try:
                future.set_result(fn(*args, **kwargs))
            except Exception as error:  # it belongs to who asks for the result
                future.set_exception(error)
        return future


def careful_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    start: Callable[[int], Executor],
    jobs: int,
    limit_s: float,
) -> Generator[tuple[Item, Result | Loss]]:
    """Yield every item with `function(item)`, as they come; few are in memory at a time.

    Where a process dies, what was under way is done again, one by one. An item whose process dies
    twice then is lost, and so is one that takes too long: these, and no other.

    Parameters
    ----------
    function : callable
        Importable, or a partial of what is.
    items : iterable
    start : callable
        Makes an executor of so many workers, of any kind; one that raises `BrokenExecutor` when a
        worker dies is made again.
    jobs : int
        Workers.
    limit_s : float
        What the executor allows for an item [s]: who dies later was late. Infinite for one that
        raises `Overdue`.

    Raises
    ------
    KgcpError
        If workers cannot be started.
    """
    remaining = iter(items)
    pending: dict[Future[Result], Item] = {}
    pool = start(jobs)
    try:
        while True:
            for item in islice(remaining, max(1, 2 * jobs) - len(pending)):
                pending[_submitted(pool, function, item)] = item
            if not pending:
                break
            done = _done_of(pending, FIRST_COMPLETED)
            if any(map(_is_broken, done)):
                done = _done_of(pending, ALL_COMPLETED)
            suspects = [pending.pop(future) for future in done if _is_broken(future)]
            for future in done & pending.keys():
                yield pending.pop(future), future.result()
            if suspects:
                pool.shutdown(wait=True, cancel_futures=True)
                yield from _one_by_one(function, suspects, start, limit_s)
                pool = start(jobs)
    except BaseException:
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown(wait=True)


def _submitted(pool: Executor, function: Callable[[Item], Result], item: Item) -> Future[Result]:
    try:
        return pool.submit(function, item)
    except BrokenExecutor as error:  # as if it had broken a moment later
        future: Future[Result] = Future()
        future.set_exception(error)
        return future


def _is_broken(future: Future[Any]) -> bool:
    return isinstance(_settled(future).exception(), BrokenExecutor)


def _settled(future: Future[Result]) -> Future[Result]:
    _done_of((future,), ALL_COMPLETED)
    return future


def _done_of(futures: Collection[Future[Result]], awaited: str) -> set[Future[Result]]:
    """Wait as `wait` does, in short turns between which a signal may stop the work.

    It may not inside `wait`, which would keep the futures' locks, for which the executor then
    waits for ever.
    """
    while True:
        with stops_held():
            done, pending = wait(futures, timeout=_TURN_S, return_when=awaited)
        if not pending or (done and awaited == FIRST_COMPLETED):
            return done


def _one_by_one(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    start: Callable[[int], Executor],
    limit_s: float,
) -> Iterator[tuple[Item, Result | Loss]]:
    pool = None
    try:
        for item in items:
            for _ in range(_TRIES):
                pool = pool or _ready(start)
                began_s = time.monotonic()
                future = _submitted(pool, function, item)
                if not _is_broken(future):
                    yield item, future.result()
                    break
                pool.shutdown(wait=True, cancel_futures=True)
                pool = None
                is_overdue = isinstance(future.exception(), Overdue)
                if is_overdue or time.monotonic() - began_s >= limit_s:
                    yield item, Loss.LATE
                    break
            else:
                yield item, Loss.DIED
    finally:
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)


def _ready(start: Callable[[int], Executor]) -> Executor:
    """Return an executor whose one worker has shown that it lives."""
    for _ in range(_STARTS):
        pool = start(1)
        if not _is_broken(_submitted(pool, _nothing, None)):
            return pool
        pool.shutdown(wait=True, cancel_futures=True)
    raise KgcpError(
        "processes end as soon as they are started; free memory, or work in this one with --jobs 0"
    )


def _nothing(_: None) -> None:
    pass
