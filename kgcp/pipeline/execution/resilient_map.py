"""Work on many items in spite of processes that die or hang: only the guilty item is lost."""

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

_LONGEST_WAIT_S = 0.5  # during which Windows hears no Ctrl-C, before Python 3.13


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class TaskFailure(Enum):
    """Why an item has no result."""

    CRASHED = auto()  # the process that worked on it ended
    TIMED_OUT = auto()  # it took longer than it may


class Lost(Exception):  # noqa: N818 - the outcome of one item, of which the map makes a value
    """The process that made a call has ended, or was ended, without a result."""

    def __init__(self, loss: TaskFailure) -> None:
        super().__init__(loss)
        self.loss = loss


class SerialExecutor(Executor):
    """Works in this process, at once: its end is the end of all. Signals wait for a call's end."""

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
    """Yield every item with `function(item)`, as they come; few are in memory at a time.

    An item that is lost is tried once more when all others are done: alone, since memory may have
    run out because of what others needed at the same time. If it is lost again, it stays lost.

    Parameters
    ----------
    function : callable
        Importable, or a partial of what is.
    executor : Executor
        One whose calls raise `Lost` when their process ends. It stays open.
    jobs : int
        Calls that it makes at a time.

    Raises
    ------
    Exception
        As the function does.
    """
    remaining = iter(items)
    pending: dict[Future[Result], Item] = {}
    suspects: list[Item] = []
    # Unlike `concurrent.futures.wait`, this queue's `get` may be left by a signal's exception: it
    # is written in C, and leaves no lock behind for which another thread would wait for ever.
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
    """Return the call that ends next; a signal's exception may end the wait."""
    while True:
        with suppress(Empty):
            return done.get(timeout=_LONGEST_WAIT_S)
