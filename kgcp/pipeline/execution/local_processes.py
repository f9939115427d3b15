"""Processes of this machine, which neither outlive their parent nor work too long on one item."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

from kgcp.pipeline.execution.signals import stops_held
from kgcp.pipeline.execution.threads import use_one_thread_each


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
        use_one_thread_each()
        context = multiprocessing.get_context("spawn")  # forking a threaded parent may deadlock
        self._limit_s = limit_s
        self._held, self._leash = context.Pipe(duplex=False)
        super().__init__(jobs, context, initializer=_begin, initargs=(self._held,))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a process make a call within the limit of time."""
        with stops_held():
            return super().submit(_within, self._limit_s, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - the base class's signature
        """End the processes; with `cancel_futures` in the midst of their work."""
        with stops_held():
            if cancel_futures:
                self._leash.close()
            super().shutdown(wait, cancel_futures=cancel_futures)
            self._leash.close()
            self._held.close()


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
