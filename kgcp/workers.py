"""Work on many items by a pool of processes: in order, or in spite of processes that die."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from enum import Enum, auto
from itertools import islice
from typing import Any, TypeVar

from kgcp.errors import KgcpError

Item = TypeVar("Item")
Result = TypeVar("Result")

_THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_STARTS = 3  # of a process, before it counts as impossible
_TRIES = 2  # of an item alone: the first death may have come before its turn


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
        with _interrupts_held():
            results = pool.map(function, items, chunksize=items_per_task)
        yield from results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class Loss(Enum):
    """Why an item has no result."""

    DIED = auto()  # the process that worked on it ended
    LATE = auto()  # it took longer than it may


class Inline(Executor):
    """Works in this process, at once: its end is the end of all."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Return the result of a call as a future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # it belongs to who asks for the result
            future.set_exception(error)
        return future


class LocalPool(ProcessPoolExecutor):
    """Processes of this machine, none of which outlives this one or works too long on one item.

    They hold one end of a pipe and end when the other one closes, however that happens.

    Parameters
    ----------
    jobs : int
        Processes.
    limit_s : float
        Time for one call [s], after which the kernel ends its process: also inside a decoder.
    """

    def __init__(self, jobs: int, limit_s: float) -> None:
        use_one_core_each()
        context = multiprocessing.get_context("spawn")  # forking a threaded parent may deadlock
        self._limit_s = limit_s
        self._held, self._leash = context.Pipe(duplex=False)
        super().__init__(jobs, context, initializer=_begin, initargs=(self._held,))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a process make a call within the limit of time."""
        with _interrupts_held():
            return super().submit(_within, self._limit_s, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - the base class's signature
        """End the processes; with `cancel_futures` in the midst of their work."""
        if cancel_futures:
            self._leash.close()
        super().shutdown(wait, cancel_futures=cancel_futures)
        self._leash.close()
        self._held.close()


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
        What the executor allows for an item [s]: who dies later was late.

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
            done, _ = wait(pending, return_when=FIRST_COMPLETED)
            if any(map(_is_broken, done)):
                done, _ = wait(pending)
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
    return isinstance(future.exception(), BrokenExecutor)


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
                if time.monotonic() - began_s >= limit_s:
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


def _begin(leash: multiprocessing.connection.Connection) -> None:
    """Set up a worker: it ends by its parent's will, by its parent's end, and by its alarm."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    threading.Thread(target=_end_with, args=(leash,), daemon=True).start()


def _end_with(leash: multiprocessing.connection.Connection) -> None:
    leash.poll(None)  # nothing is ever sent: until the other end is closed
    os._exit(1)


def _within(
    limit_s: float,
    function: Callable[..., Any],
    *args: Any,  # noqa: ANN401 - those of any function
    **kwargs: Any,  # noqa: ANN401
) -> Any:  # noqa: ANN401
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return function(*args, **kwargs)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back while processes are started, who inherit it: the parent stops them."""
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
