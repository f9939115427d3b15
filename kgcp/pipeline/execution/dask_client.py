"""A Dask cluster as workers: the frames of one flight, looked at by many machines.

Dask carries frames' names out and results home, and sends elsewhere what a machine that is gone had
in its hands. `kgcp.pipeline.execution.dask_worker` is what happens there.
"""

from __future__ import annotations

import logging
import re
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kgcp.errors import KgcpError
from kgcp.io.tables.provenance import versions
from kgcp.pipeline.execution.dask_worker import Terms, nothing, on_worker, release
from kgcp.pipeline.execution.signals import stops_held

if TYPE_CHECKING:
    from distributed import Client

_LOCAL = re.compile(r"local:([1-9]\d{0,2})")
_CONNECT_S = 5.0  # for the scheduler to answer
_WORKERS_S = 120.0  # without any worker, after which nobody waits any more
_WATCH_S = 2.0  # between two looks whether there are workers


class Cluster:
    """The workers of a Dask scheduler; made by `connected`.

    Parameters
    ----------
    name : str
        Of the scheduler, for messages.
    client : Client
    terms : Terms

    Attributes
    ----------
    name : str
    """

    def __init__(self, name: str, client: Client, terms: Terms) -> None:
        self.name = name
        self._client, self._terms = client, terms
        self._waiting: set[Future[Any]] = set()
        self._is_over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def jobs(self) -> int:
        """Threads of the workers that are there now; at least one."""
        with stops_held():
            threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))

    def executor(self) -> Executor:
        """Return an executor whose calls the workers make."""
        return _Calls(self)

    def close(self) -> None:
        """End the processes that the workers keep for this run."""
        self._is_over.set()
        with stops_held(), suppress(Exception):  # a cluster that is gone has none
            self._client.run(release, self._terms.run, on_error="ignore")

    def client_executor(self) -> Executor:
        """Return Dask's own executor."""
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    def promised(
        self, executor: Executor, function: Callable[..., Any], arguments: tuple[Any, ...]
    ) -> Future[Any]:
        """Let a worker make a call by Dask's executor; errors become what they mean here."""
        future: Future[Any] = Future()
        self._waiting.add(future)
        inner = executor.submit(on_worker, self._terms, function, *arguments)
        inner.add_done_callback(partial(self._hand_over, future))
        return future

    def _hand_over(self, future: Future[Any], inner: Future[Any]) -> None:
        if inner.cancelled():
            self._fail(future, self._gone("has dropped the work"))
            return
        error = inner.exception()
        if type(error).__name__ == "KilledWorker":  # of distributed: several workers in its hands
            self._fail(future, BrokenExecutor(str(error)))
        elif isinstance(error, ImportError):
            self._fail(
                future,
                KgcpError(
                    f"{self.name}: a worker cannot do this work ({error}); install kgcp"
                    f" {self._terms.versions['kgcp']} on all of them"
                ),
            )
        elif error is not None:
            self._fail(future, error)
        elif self._claims(future):
            future.set_result(inner.result())

    def _fail(self, future: Future[Any], error: BaseException) -> None:
        if self._claims(future):
            future.set_exception(error)

    def _claims(self, future: Future[Any]) -> bool:
        """Tell the thread that is to settle a future that it is the first."""
        try:
            self._waiting.remove(future)
        except KeyError:
            return False
        return True

    def _watch(self) -> None:
        """Give up what nobody will do: it would be waited for without end."""
        alone_s = 0.0
        while not self._is_over.wait(_WATCH_S):
            try:
                is_alone = not self._client.nthreads()
            except Exception:  # whatever a broken connection raises
                is_alone = True
            alone_s = alone_s + _WATCH_S if is_alone else 0.0
            if alone_s >= _WORKERS_S:
                for future in tuple(self._waiting):
                    self._fail(future, self._gone(f"has had no workers for {alone_s:.0f} s"))

    def _gone(self, what: str) -> KgcpError:
        return KgcpError(
            f"{self.name}: the scheduler {what}; when it has workers, the same command goes on"
        )


class _Calls(Executor):
    """Calls made by a cluster: its shutdown drops what is under way, and leaves the workers."""

    def __init__(self, cluster: Cluster) -> None:
        self._cluster = cluster
        with stops_held():
            self._dask = cluster.client_executor()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - the base class's signature
        """Let a worker make a call."""
        with stops_held():
            return self._cluster.promised(self._dask, partial(fn, **kwargs), args)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002 - the base class's signature
        """Wait for what is under way, or drop it."""
        with stops_held():
            self._dask.shutdown(wait=wait and not cancel_futures)


@contextmanager
def connected(scheduler: str, limit_s: float, folders: tuple[Path, ...]) -> Iterator[Cluster]:
    """Have the workers of a Dask scheduler until the block ends.

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
    client, closing = _connect(scheduler)
    try:
        terms = Terms(uuid.uuid4().hex, limit_s, versions(), folders)
        cluster = Cluster(scheduler, client, terms)
        try:
            _require_workers(cluster)
            yield cluster
        finally:
            cluster.close()
    finally:
        with stops_held():
            closing()


def _connect(scheduler: str) -> tuple[Client, Callable[[], None]]:
    """Return a client, and what ends it and whatever was started for it."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise KgcpError(
            f"--scheduler {scheduler}: needs Dask ({error}); pip install 'kgcp[dask]'"
        ) from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # said below, in one line
    local = _LOCAL.fullmatch(scheduler)
    if local is None and "://" not in scheduler:
        raise KgcpError(
            f"--scheduler {scheduler}: is no address; give one like tcp://10.0.0.1:8786, or local:4"
        )
    try:
        with stops_held():
            if local is None:
                client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
                return client, client.close
            own = LocalCluster(  # in this process, where nobody else can give it work
                n_workers=int(local[1]),
                threads_per_worker=1,
                processes=False,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
            client = Client(own, set_as_default=False)
    except Exception as error:  # who answers may be anybody, and anything is raised
        raise KgcpError(
            f"--scheduler {scheduler}: cannot be reached ({error}); see that it runs, and that this"
            " machine may connect to it"
        ) from error

    def close() -> None:
        client.close()
        own.close()

    return client, close


def _require_workers(cluster: Cluster) -> None:
    """Have a first call made, which finds out most of what can be wrong with workers."""
    calls = cluster.executor()
    try:
        future = calls.submit(nothing)
        while not future.done():
            with suppress(TimeoutError), stops_held():
                future.exception(timeout=0.2)
        future.result()
    except BrokenExecutor as error:
        raise KgcpError(
            f"{cluster.name}: a worker's process ends as soon as it is started ({error}); see the"
            " worker's log, and give it memory"
        ) from error
    finally:
        calls.shutdown(cancel_futures=True)
