"""A map over many items that survives processes that die or hang: only their item is lost."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor, Future
from contextlib import suppress
from enum import Enum, auto
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from kgcp.pipeline.execution.signals import defer_interrupts

Item = TypeVar("Item")
Result = TypeVar("Result")

_MAX_WAIT_S = 0.5  # before Python 3.13, Windows does not react to Ctrl-C during a wait


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class TaskFailure(Enum):
    """Why an item has no result."""

    CRASHED = auto()  # its process ended
    TIMED_OUT = auto()  # it exceeded the time limit


class Lost(Exception):  # noqa: N818 - the outcome of one item, of which the map makes a value
    """The process that made a call has ended, or was ended, without a result."""

    def __init__(self, loss: TaskFailure) -> None:
        super().__init__(loss)
        self.loss = loss


class SerialExecutor(Executor):
    """Makes calls immediately in this process, without protection. Signals wait for their end."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Return the result of a call as a future that is done."""
        future: Future[Any] = Future()
        with defer_interrupts():
            try:
                future.set_result(fn(*args, **kwargs))
            except Exception as error:  # for the caller that asks for the result
                future.set_exception(error)
        return future


def resilient_map(
    function: Callable[[Item], Result], items: Iterable[Item], executor: Executor, jobs: int
) -> Generator[tuple[Item, Result | TaskFailure]]:
    """Yield every item with `function(item)` as they are completed; few are in memory at a time.

    A lost item is tried once more after all others, and alone: memory may have run out because of
    other items. If it is lost again, it stays lost.

    Parameters
    ----------
    function : callable
        An importable function, or a partial of one.
    executor : Executor
        Its calls raise `Lost` when their process ends. It stays open.
    jobs : int
        Number of calls that the executor makes at a time.

    Raises
    ------
    Exception
        As the function does.
    """
    remaining = iter(items)
    pending: dict[Future[Result], Item] = {}
    suspects: list[Item] = []
    # A signal's exception may interrupt this queue's `get`, unlike `concurrent.futures.wait`. The
    # queue is written in C, and leaves no lock behind on which another thread would wait for ever.
    done: SimpleQueue[Future[Result]] = SimpleQueue()

    def submit(item: Item) -> None:
        with defer_interrupts():
            future = executor.submit(function, item)
            pending[future] = item
            future.add_done_callback(done.put)

    while True:
        for item in islice(remaining, max(1, 2 * jobs) - len(pending)):
            submit(item)
        if not pending:
            break
        future = _next(done)
        item = pending.pop(future)
        if isinstance(future.exception(), Lost):
            suspects.append(item)
        else:
            yield item, future.result()
    for item in suspects:
        submit(item)
        future = _next(done)
        error = future.exception()
        yield item, error.loss if isinstance(error, Lost) else future.result()


def _next(done: SimpleQueue[Future[Result]]) -> Future[Result]:
    """Return the next call that ends; a signal's exception may interrupt the wait."""
    while True:
        with suppress(Empty):
            return done.get(timeout=_MAX_WAIT_S)
