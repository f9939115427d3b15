"""Processes of this machine that make calls: killed when late, and gone when their parent is.

Every process has a pipe of its own. With a queue that processes share, one that is killed while it
holds the queue's lock stops all others: that ruled out `ProcessPoolExecutor`, which ends all work
then, and `pebble.ProcessPool`, which waits for ever (seen after six kills in the midst of results).

Under Linux, processes are forked from a server, a process without threads that has loaded what they
need: once, and while this process loads what it needs itself. Elsewhere, forks are not safe with
the system's libraries, and each process loads everything.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from multiprocessing import forkserver
from multiprocessing.connection import wait
from typing import Any

from kgcp.errors import KgcpError
from kgcp.pipeline.execution.resilient_map import Lost, TaskFailure
from kgcp.pipeline.execution.signals import defer_interrupts
from kgcp.pipeline.execution.threads import use_one_thread_each

# forking this process, which has threads, might deadlock
if sys.platform == "linux":
    _CONTEXT = multiprocessing.get_context("forkserver")
else:
    _CONTEXT = multiprocessing.get_context("spawn")
_Connection = Any  # of multiprocessing: `Connection`, or `PipeConnection` on Windows
_STARTS = 3  # of a process, before it counts as impossible
_LONGEST_WAIT_S = 1e6  # that the kernel can be asked for


def start_server(*modules: str) -> None:
    """Let the server of new processes start to load these modules, and return at once.

    Nothing is done where there is no server, or where it runs already.
    """
    if sys.platform == "linux":
        use_one_thread_each()
        forkserver.set_forkserver_preload(list(modules))
        with defer_interrupts():  # which the server inherits: Ctrl-C is for this process
            forkserver.ensure_running()


class Preparation:
    """What new processes do before their first call.

    Parameters
    ----------
    quick : callable
        Returns whether that was enough.
    slow : callable
        What else it takes. One process at a time does it, and leaves what the others need.
    parts : sequence of callable, optional
        Of what is slow, each done once, and at the same time as the others.
    """

    def __init__(
        self,
        quick: Callable[[], bool],
        slow: Callable[[], object],
        parts: Sequence[Callable[[], object]] = (),
    ) -> None:
        self.quick, self.slow = quick, slow
        self.lock = threading.Lock()  # of `slow`
        self._parts_left, self._parts_begun = list(parts), 0
        self._part_ended = threading.Condition()

    def share_parts(self, do: Callable[[Callable[[], object]], object]) -> None:
        """Do the parts that no other process has begun, and wait for the end of all others.

        One that fails is not begun again: then `slow` does it.
        """
        while True:
            with self._part_ended:
                if not self._parts_left:
                    self._part_ended.wait_for(lambda: not self._parts_begun)
                    return
                part = self._parts_left.pop(0)
                self._parts_begun += 1
            try:
                do(part)
            finally:
                with self._part_ended:
                    self._parts_begun -= 1
                    self._part_ended.notify_all()


class WorkerProcess:
    """A process that makes one call at a time; started when first needed, and again after a loss.

    Parameters
    ----------
    limit_s : float
        Time for one call [s], after which the process is killed: also inside a decoder.
    """

    def __init__(self, limit_s: float, preparation: Preparation | None = None) -> None:
        self._limit_s = min(limit_s, _LONGEST_WAIT_S)
        self._preparation = preparation
        self._lock = threading.Lock()  # of starting and killing, which two threads may do
        self._is_over = False
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: _Connection | None = None
        self._function: Callable[..., Any] | None = None  # what the process has been sent

    def call(self, function: Callable[..., Any], /, *args: Any) -> Any:  # noqa: ANN401 - those of any function
        """Return the result of a call.

        Raises
        ------
        Lost
            If the process ends, or the call takes too long.
        KgcpError
            If processes cannot be started.
        Exception
            As the function does.
        """
        connection = self._connection or self._start()
        self._send(connection, function)
        return self._answer(connection, self._limit_s, args)

    def end(self) -> None:
        """Kill the process, and start none any more; a call under way is lost."""
        self._is_over = True
        self._kill()

    def _send(self, connection: _Connection, function: Callable[..., Any]) -> None:
        if function is not self._function:
            self._answer(connection, None, function)  # may import much: not counted as work
            self._function = function

    def _prepare(self, connection: _Connection, preparation: Preparation) -> None:
        """Let a new process get ready, however long it takes: not counted as work."""
        do = partial(self._do, connection)
        if do(preparation.quick):
            return
        preparation.share_parts(do)
        with preparation.lock:  # meanwhile another process may have done what is slow
            if not do(preparation.quick):
                do(preparation.slow)

    def _do(self, connection: _Connection, prepare: Callable[[], object]) -> object:
        """Return what a function of the preparation returns in the process."""
        self._send(connection, prepare)
        return self._answer(connection, _LONGEST_WAIT_S, ())

    def _answer(self, connection: _Connection, limit_s: float | None, sent: object) -> Any:  # noqa: ANN401 - of any call
        try:
            connection.send((limit_s is None, sent))
            if connection.poll(limit_s):
                result, error = connection.recv()
            else:
                result, error = None, Lost(TaskFailure.TIMED_OUT)
        except (EOFError, OSError):
            result, error = None, Lost(TaskFailure.CRASHED)
        if isinstance(error, Lost):
            self._kill()
        if error is not None:
            raise error
        return result

    def _start(self) -> _Connection:
        for _ in range(_STARTS):
            own, other = _CONTEXT.Pipe()
            try:
                with self._lock:
                    if self._is_over:
                        raise Lost(TaskFailure.CRASHED)
                    use_one_thread_each()
                    self._process = _CONTEXT.Process(target=_serve, args=(other,), daemon=True)
                    self._process.start()
                other.close()
                own.recv()  # it is there: its start is not counted as work
                if self._preparation is not None:
                    self._prepare(own, self._preparation)
            except (EOFError, OSError, Lost):
                self._kill()
                if self._is_over:
                    raise Lost(TaskFailure.CRASHED) from None
            except BaseException:
                self._kill()
                raise
            else:
                self._connection = own
                return own
        raise KgcpError(
            "worker processes end as soon as they start; free memory, or work without them",
            option="jobs 0",
        )

    def _kill(self) -> None:
        with self._lock:
            process, self._process = self._process, None
            self._connection = self._function = None
            if process is not None and process.pid is not None:
                process.kill()
                process.join()


def _serve(connection: _Connection) -> None:
    """Make calls until the parent closes the pipe, or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # a parent that is killed may leave results unread, which resets the pipe
    with suppress(EOFError, ConnectionError):
        connection.send(None)
        _answer(connection)


def _answer(connection: _Connection) -> None:
    """Make the calls that come, and send what they return or raise."""
    function: Any = None  # of the calls, until another one comes
    while True:
        data = connection.recv_bytes()
        result, error = None, None
        try:
            is_function, sent = pickle.loads(data)  # noqa: S301 - the parent's own
            if is_function:
                function = sent
            else:
                result = function(*sent)
        except Exception as raised:
            error = _portable(raised)
        connection.send((result, error))


def _end_with_parent() -> None:
    """End in the midst of work as soon as the parent is gone, however it went."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _portable(error: Exception) -> Exception:
    """Return what arrives in another process, with a note of where it was raised."""
    error.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    except Exception:  # whatever the constructor of an exception demands
        return RuntimeError("".join(traceback.format_exception(error)))
    return error


class SupervisedProcessPool(ThreadPoolExecutor):
    """Threads, each of which lets a process of its own make its calls.

    Parameters
    ----------
    limit_s : float
        Time for one call [s].
    """

    def __init__(self, jobs: int, limit_s: float, preparation: Preparation | None = None) -> None:
        super().__init__(jobs)
        self._workers = [WorkerProcess(limit_s, preparation) for _ in range(jobs)]
        self._idle = list(self._workers)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a process make a call, within the limit of time."""
        # Threads and processes inherit that they leave Ctrl-C to this one.
        with defer_interrupts():
            return super().submit(self._call, fn, *args, **kwargs)

    def _call(self, function: Callable[..., Any], /, *args: Any) -> Any:  # noqa: ANN401 - those of any function
        worker = self._idle.pop()  # the one that was busy last; there are as many as threads
        try:
            return worker.call(function, *args)
        finally:
            self._idle.append(worker)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:  # noqa: FBT001, FBT002 - the base class's signature
        """End the processes, also in the midst of their work."""
        with defer_interrupts():
            super().shutdown(wait=False, cancel_futures=cancel_futures)
            for worker in self._workers:
                worker.end()
            super().shutdown(wait=wait)
