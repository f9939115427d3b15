"""In a Dask worker: calls are made in processes beside it, and not in its threads.

Every thread keeps one process and gives its frames to that. What ends a process or hangs there ends
nothing of Dask's, the limit of time is the kernel's as at home, and threads do not meet inside a
decoder whose complaints are the whole process's.
"""

from __future__ import annotations

import math
import multiprocessing
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from kgcp.errors import KgcpError
from kgcp.io.tables.provenance import versions
from kgcp.pipeline.execution.local_processes import LocalPool
from kgcp.pipeline.execution.resilient_map import Overdue

_pools: dict[int, tuple[str, LocalPool]] = {}  # by thread: a run, and one process for it
_pools_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class Terms:
    """What a worker's calls go by.

    Attributes
    ----------
    run : str
        Tells runs apart.
    limit_s : float
        Time for one call [s].
    versions : mapping of str
        Of what results depend on: others may give other bytes.
    folders : tuple of Path
        What must be seen from everywhere.
    """

    run: str
    limit_s: float
    versions: Mapping[str, str]
    folders: tuple[Path, ...]


def nothing() -> None:
    """Do nothing: to be called shows that the way there and back is open."""


def on_worker(terms: Terms, function: Callable[..., Any], *args: Any) -> Any:  # noqa: ANN401 - those of any function
    """Make a call in the process that belongs to this thread of a worker.

    Raises
    ------
    BrokenExecutor
        If the process ends; `Overdue` if the limit of time ended it.
    KgcpError
        If the worker is not as the terms want it.
    Exception
        As the function does.
    """
    _require_same_versions(terms)
    for folder in terms.folders:
        if not folder.is_dir():
            raise KgcpError(
                f"{folder}: is not seen by the worker {_here()}; mount it there under the same name"
            )
    began_s = math.inf
    try:
        pool = _pool(terms)
        began_s = time.monotonic()
        return pool.submit(function, *args).result()
    except BrokenExecutor as error:
        _drop(threading.get_ident())
        if time.monotonic() - began_s >= terms.limit_s:
            raise Overdue(f"after {terms.limit_s} s") from error
        raise


def _require_same_versions(terms: Terms) -> None:
    here = _own_versions()
    differing = [name for name, value in terms.versions.items() if here.get(name) != value]
    if differing:
        name = differing[0]
        raise KgcpError(
            f"the worker {_here()}: has {name} {here.get(name)}, not {terms.versions[name]}, and"
            " might give other results; install the same versions everywhere"
        )


@cache
def _own_versions() -> Mapping[str, str]:
    return versions()


def _here() -> str:
    from distributed import get_worker

    return str(get_worker().address)


def _pool(terms: Terms) -> LocalPool:
    thread = threading.get_ident()
    with _pools_lock:
        run, pool = _pools.get(thread, (None, None))
    if pool is None or run != terms.run:
        _drop(thread)  # of a run that had no time to say that it ends
        # Dask's workers may have no children, lest these outlive them. Ours end with their parent.
        multiprocessing.current_process().daemon = False
        pool = LocalPool(1, terms.limit_s)
        with _pools_lock:
            _pools[thread] = (terms.run, pool)
        pool.submit(nothing).result()  # its start is not counted as work
    return pool


def _drop(thread: int) -> None:
    with _pools_lock:
        _, pool = _pools.pop(thread, (None, None))
    if pool is not None:
        pool.shutdown(cancel_futures=True)


def release(run: str) -> None:
    """End all processes of a run."""
    with _pools_lock:
        threads = [thread for thread, (owner, _) in _pools.items() if owner == run]
    for thread in threads:
        _drop(thread)
