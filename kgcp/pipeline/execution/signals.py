"""Signals that stop the program, deferred where they would do harm."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_STOPS = (signal.SIGINT, signal.SIGTERM)


def _block_interrupts() -> Callable[[], object]:
    """Block SIGINT in this thread and in processes that it starts; return a function to undo it.

    Windows has no masks: there a process that is started gets Ctrl-C, too, and ignores it itself.
    """
    set_mask: Any = getattr(signal, "pthread_sigmask", None)
    if set_mask is None:
        return lambda: None
    block, restore = (getattr(signal, name) for name in ("SIG_BLOCK", "SIG_SETMASK"))
    mask = set_mask(block, {signal.SIGINT})
    return lambda: set_mask(restore, mask)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer SIGINT and SIGTERM until the block ends.

    An exception that a signal's handler raises between two lines of an executor's code leaves a
    lock behind, for which another thread then waits for ever; raised while a compiled function
    makes Python's objects of its result, it ends as a `SystemError`. Processes started in the block
    inherit that Ctrl-C is blocked.
    """
    if threading.current_thread() is not threading.main_thread():  # where no handler runs
        yield
        return
    came: list[int] = []
    handlers: dict[signal.Signals, Any] = {}
    unblock = _block_interrupts()
    try:
        for stop in _STOPS:
            handlers[stop] = signal.signal(stop, lambda number, _: came.append(number))
        yield
    finally:
        for stop, handler in handlers.items():
            signal.signal(stop, handler)
        unblock()
        for number in came:
            signal.raise_signal(number)
