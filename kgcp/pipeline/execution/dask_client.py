"""A Dask cluster as workers: many machines examine the frames of one flight.

Dask sends frames' names out and results back, and gives the work of a machine that is gone to
others. `kgcp.pipeline.execution.dask_worker` is the part that runs there.
"""

from __future__ import annotations

import logging
import re
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, InvalidStateError
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kgcp.errors import KgcpError
from kgcp.io.tables.provenance import versions
from kgcp.pipeline.execution.dask_worker import JobContext, nothing, on_worker, release
from kgcp.pipeline.execution.resilient_map import Lost, TaskFailure, resilient_map
from kgcp.pipeline.execution.signals import defer_interrupts

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

_LOCAL = re.compile(r"local:([1-9]\d{0,2})")
_CONNECT_S = 5.0  # for the scheduler to answer
_WORKERS_S = 120.0  # time without any worker after which the run fails
_WATCH_S = 2.0  # between two checks whether there are workers


class DaskCluster(Executor):
    """Calls made by the workers of a Dask scheduler; made by `connected`.

    Parameters
    ----------
    name : str
        Of the scheduler, for messages.
    """

    def __init__(self, name: str, client: Client, context: JobContext) -> None:
        self._name, self._client, self._context = name, client, context
        self._waiting: set[Future[Any]] = set()
        self._is_over = threading.Event()
        with defer_interrupts():
            self._dask: Executor = client.get_executor(pure=False)
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def jobs(self) -> int:
        """Threads of the workers that are there now; at least one."""
        with defer_interrupts():
            threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a worker make a call; Dask's errors become those of this package."""
        future: Future[Any] = Future()
        self._waiting.add(future)
        with defer_interrupts():
            inner = self._dask.submit(on_worker, self._context, fn, *args, **kwargs)
            inner.add_done_callback(partial(self._hand_over, future))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:  # noqa: ARG002, FBT001, FBT002 - the base class's signature
        """Drop what is under way, and end the processes that the workers keep for this run."""
        self._is_over.set()
        with defer_interrupts(), suppress(Exception):  # a cluster that is gone has none
            self._dask.shutdown(wait=False)
            self._client.run(release, self._context.run, on_error="ignore")

    def _hand_over(self, future: Future[Any], inner: Future[Any]) -> None:
        if inner.cancelled():
            self._settle(future, self._gone("has dropped the work"))
            return
        error = inner.exception()
        if type(error).__name__ == "KilledWorker":  # of distributed: several workers died of it
            error = Lost(TaskFailure.CRASHED)
        elif isinstance(error, ImportError):
            error = KgcpError(
                f"{self._name}: a worker cannot do this work ({error}); install kgcp"
                f" {self._context.versions['kgcp']} on all of them"
            )
        self._settle(future, error, None if error is not None else inner.result())

    def _settle(
        self, future: Future[Any], error: BaseException | None, result: object = None
    ) -> None:
        """Give a future its result or its error; the first of two threads does it."""
        self._waiting.discard(future)
        with suppress(InvalidStateError):
            if error is None:
                future.set_result(result)
            else:
                future.set_exception(error)

    def _watch(self) -> None:
        """Fail the calls that wait if there has been no worker for a long time."""
        alone_s = 0.0
        while not self._is_over.wait(_WATCH_S):
            try:
                is_alone = not self._client.nthreads()
            except Exception:  # whatever a broken connection raises
                is_alone = True
            alone_s = alone_s + _WATCH_S if is_alone else 0.0
            if alone_s >= _WORKERS_S:
                for future in tuple(self._waiting):
                    self._settle(future, self._gone(f"has had no workers for {alone_s:.0f} s"))

    def _gone(self, what: str) -> KgcpError:
        return KgcpError(
            f"{self._name}: the scheduler {what}; once it has workers, the same command resumes"
        )


@contextmanager
def connected(scheduler: str, limit_s: float, folders: tuple[Path, ...]) -> Iterator[DaskCluster]:
    """Provide the workers of a Dask scheduler until the block ends.

    Parameters
    ----------
    scheduler : str
        Its address, as `tcp://10.0.0.1:8786`; or `local:N` for one in this process, with N
        workers.
    limit_s : float
        Time for one call [s].
    folders : tuple of Path
        Absolute; what the workers must see under the same names.

    Raises
    ------
    KgcpError
        If Dask is not installed, the scheduler does not answer or has no workers, or a worker
        cannot do this work: it has other versions, or does not see a folder.
    """
    with ExitStack() as stack:
        client = _connect(scheduler, stack)
        cluster = DaskCluster(
            scheduler, client, JobContext(uuid.uuid4().hex, limit_s, versions(), folders)
        )
        stack.callback(cluster.shutdown)
        ((_, result),) = resilient_map(nothing, (None,), cluster, 1)  # finds most that can be wrong
        if isinstance(result, TaskFailure):
            raise KgcpError(
                f"{scheduler}: a worker's process ends as soon as it is started; see the worker's"
                " log, and give it memory"
            )
        yield cluster


def _connect(scheduler: str, stack: ExitStack) -> Client:
    """Return a client; the stack ends it, and a cluster that was started for it."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise KgcpError(
            f"scheduler {scheduler}: needs Dask ({error}); pip install 'kgcp[dask]'"
        ) from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # said below, in one line
    local = _LOCAL.fullmatch(scheduler)
    if local is None and "://" not in scheduler:
        raise KgcpError(
            f"scheduler {scheduler}: is not an address; give one like tcp://10.0.0.1:8786, or"
            " local:4",
            option="scheduler",
        )
    address: str | LocalCluster = scheduler
    try:
        with defer_interrupts():
            if local is not None:
                address = LocalCluster(  # in this process, where others cannot submit work
                    n_workers=int(local[1]),
                    threads_per_worker=1,
                    processes=False,
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )
                stack.callback(_close, address)
            client = Client(address, timeout=_CONNECT_S, set_as_default=False)
            stack.callback(_close, client)
    except Exception as error:  # any server may answer, and anything is raised
        raise KgcpError(
            f"scheduler {scheduler}: cannot be reached ({error}); check that it runs and that this"
            " machine can connect to it"
        ) from error
    return client


def _close(each: Client | LocalCluster) -> None:
    with defer_interrupts():
        each.close()
