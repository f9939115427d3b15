"""Worker processes of this machine: killed if a call takes too long, and ended with their parent.

Every process has its own pipe. If processes share a queue, and one is killed while it holds the
queue's lock, all others stop. `ProcessPoolExecutor` then ends all work, and `pebble.ProcessPool`
waits for ever, as observed after six kills while results were sent. So neither is used.

Under Linux, processes are forked from a server, which is a process without threads. It loads what
they need once, while this process loads what it needs itself. On other systems, forking is not safe
with the system's libraries, and each process loads everything.
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
from kgcp.io.files.portable import raised_limit_of_open_files
from kgcp.pipeline.execution.resilient_map import Lost, TaskFailure
from kgcp.pipeline.execution.signals import defer_interrupts
from kgcp.pipeline.execution.threads import use_one_thread_each

# this process has threads: forking it might deadlock
if sys.platform == "linux":
    _CONTEXT = multiprocessing.get_context("forkserver")
else:
    _CONTEXT = multiprocessing.get_context("spawn")
_Connection = Any  # of multiprocessing: `Connection`, or `PipeConnection` on Windows
_MAX_STARTS = 3  # attempts to start a process
_FILES_PER_PROCESS, _OTHER_FILES = 4, 64  # that this process has open at most
_MAX_WAIT_S = 1e6  # longest timeout that the kernel accepts


def start_server(*modules: str) -> None:
    """Start the server of new processes, which loads these modules; return at once.

    Nothing is done if this system has no server, or if it is already running.

    Raises
    ------
    KgcpError
        If its socket cannot be created, as in a temporary folder with a long name.
    """
    if sys.platform == "linux":
        use_one_thread_each()
        forkserver.set_forkserver_preload(list(modules))
        with defer_interrupts():  # the server inherits this: Ctrl-C is for this process
            try:
                forkserver.ensure_running()
            except OSError as error:
                raise KgcpError(
                    f"worker processes cannot be started ({error}); set TMPDIR to a folder with a"
                    " short name and free space, or work without them",
                    option="jobs 0",
                ) from error


class Preparation:
    """Preparation of new processes before their first call.

    Parameters
    ----------
    quick : callable
        Done first; returns whether that was enough.
    slow : callable
        Done otherwise. One process at a time does it, and leaves on the disk what the others need.
    parts : sequence of callable, optional
        Parts of the slow preparation that different processes can do at the same time, each once.
    """

    def __init__(
        self,
        quick: Callable[[], bool],
        slow: Callable[[], object],
        parts: Sequence[Callable[[], object]] = (),
    ) -> None:
        self.quick, self.slow = quick, slow
        self.lock = threading.Lock()  # of `slow`
        self._parts_waiting, self._parts_running = list(parts), 0
        self._part_ended = threading.Condition()

    def share_parts(self, do: Callable[[Callable[[], object]], object]) -> None:
        """Do parts that no other process has begun, and wait until all others have ended.

        A part that fails is not repeated; `slow` does its work.
        """
        while True:
            with self._part_ended:
                if not self._parts_waiting:
                    self._part_ended.wait_for(lambda: not self._parts_running)
                    return
                part = self._parts_waiting.pop(0)
                self._parts_running += 1
            try:
                do(part)
            finally:
                with self._part_ended:
                    self._parts_running -= 1
                    self._part_ended.notify_all()


class WorkerProcess:
    """A process that makes one call at a time; started when needed, and again after it was lost.

    Parameters
    ----------
    limit_s : float
        Time limit for one call [s]. Then the process is killed, even inside a decoder.
    """

    def __init__(self, limit_s: float, preparation: Preparation | None = None) -> None:
        self._limit_s = min(limit_s, _MAX_WAIT_S)
        self._preparation = preparation
        self._lock = threading.Lock()  # for starting and killing, which two threads may do
        self._is_ended = False
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: _Connection | None = None
        self._function: Callable[..., Any] | None = None  # the function that the process has

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
        """Kill the process and start no other one; a running call is lost."""
        self._is_ended = True
        self._kill()

    def _send(self, connection: _Connection, function: Callable[..., Any]) -> None:
        if function is not self._function:
            self._answer(connection, None, function)  # may import a lot: no time limit
            self._function = function

    def _prepare(self, connection: _Connection, preparation: Preparation) -> None:
        """Prepare a new process, without a time limit."""
        do = partial(self._do, connection)
        if do(preparation.quick):
            return
        preparation.share_parts(do)
        with preparation.lock:  # another process may have done the slow part in the meantime
            if not do(preparation.quick):
                do(preparation.slow)

    def _do(self, connection: _Connection, prepare: Callable[[], object]) -> object:
        """Call a function of the preparation in the process, and return its result."""
        self._send(connection, prepare)
        return self._answer(connection, _MAX_WAIT_S, ())

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
        for _ in range(_MAX_STARTS):
            parent_end, child_end = _CONTEXT.Pipe()
            try:
                with self._lock:
                    if self._is_ended:
                        raise Lost(TaskFailure.CRASHED)
                    use_one_thread_each()
                    process = _CONTEXT.Process(target=_serve, args=(child_end,), daemon=True)
                    self._process = process
                    process.start()
                child_end.close()
                # Windows keeps the other end open until the process takes it, however it ends
                if parent_end not in wait((parent_end, process.sentinel)):
                    raise EOFError
                parent_end.recv()  # the process has started, which does not count as work
                if self._preparation is not None:
                    self._prepare(parent_end, self._preparation)
            except (EOFError, OSError, Lost):
                self._kill()
                if self._is_ended:
                    raise Lost(TaskFailure.CRASHED) from None
            except BaseException:
                self._kill()
                raise
            else:
                self._connection = parent_end
                return parent_end
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
    """Make calls until the parent closes the pipe or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # a killed parent may leave results unread, which resets the pipe
    with suppress(EOFError, ConnectionError):
        connection.send(None)
        _answer(connection)


def _answer(connection: _Connection) -> None:
    """Receive and make calls; send what they return or raise. End if memory runs out."""
    function: Any = None  # the function to call, until another one is received
    while True:
        data = connection.recv_bytes()
        result, error = None, None
        try:
            is_function, sent = pickle.loads(data)  # noqa: S301 - the parent's own
            if is_function:
                function = sent
            else:
                result = function(*sent)
        except MemoryError:
            return  # a new process can have all of the memory, and may try again
        except Exception as raised:
            error = _portable(raised)
        connection.send((result, error))


def _end_with_parent() -> None:
    """End this process, even during a call, as soon as the parent has ended in whatever way."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _portable(error: Exception) -> Exception:
    """Return an exception that can be sent to another process, with its traceback as a note."""
    error.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    except Exception:  # constructors of exceptions may require anything
        return RuntimeError("".join(traceback.format_exception(error)))
    return error


class SupervisedProcessPool(ThreadPoolExecutor):
    """A pool of threads, each of which has its own process for its calls.

    Parameters
    ----------
    limit_s : float
        Time limit for one call [s].

    Raises
    ------
    KgcpError
        If the system does not allow as many open files as the processes need.
    """

    def __init__(self, jobs: int, limit_s: float, preparation: Preparation | None = None) -> None:
        needed = _FILES_PER_PROCESS * jobs + _OTHER_FILES
        allowed = raised_limit_of_open_files(needed)
        if allowed < needed:
            raise KgcpError(
                f"{jobs} worker processes need more open files than the system allows ({allowed});"
                " raise this limit (ulimit -n), or use fewer processes",
                option="jobs",
            )
        super().__init__(jobs)
        self._workers = [WorkerProcess(limit_s, preparation) for _ in range(jobs)]
        self._idle = list(self._workers)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a process make a call, within the time limit."""
        # new threads and processes inherit this: Ctrl-C is for this thread
        with defer_interrupts():
            return super().submit(self._call, fn, *args, **kwargs)

    def _call(self, function: Callable[..., Any], /, *args: Any) -> Any:  # noqa: ANN401 - those of any function
        worker = self._idle.pop()  # the most recently used one; there are as many as threads
        try:
            return worker.call(function, *args)
        finally:
            self._idle.append(worker)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:  # noqa: FBT001, FBT002 - the base class's signature
        """End the processes, even during their calls."""
        with defer_interrupts():
            super().shutdown(wait=False, cancel_futures=cancel_futures)
            for worker in self._workers:
                worker.end()
            super().shutdown(wait=wait)
