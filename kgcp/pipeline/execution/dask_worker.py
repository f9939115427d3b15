"""Calls in a Dask worker: made in processes beside it, and not in its threads.

Every thread keeps one process and gives its frames to that. What ends a process or hangs there
ends nothing of Dask's, and threads do not meet inside a decoder whose complaints are the whole
process's.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from kgcp.errors import KgcpError
from kgcp.io.tables.provenance import versions
from kgcp.pipeline.execution.local_processes import WorkerProcess

_processes: dict[int, tuple[str, WorkerProcess]] = {}  # by thread: a run, and one process for it


@dataclass(frozen=True, slots=True)
class JobContext:
    """Settings that a worker's calls share."""

    run: str  # tells runs apart
    limit_s: float  # time for one call [s]
    versions: Mapping[str, str]  # of what results depend on: others may give other bytes
    folders: tuple[Path, ...]  # what must be seen from everywhere


def nothing(_: object) -> None:
    """Do nothing: the call itself shows that the way there and back is open."""


def on_worker(context: JobContext, function: Callable[..., Any], *args: Any) -> Any:  # noqa: ANN401 - those of any function
    """Make a call in the process that belongs to this thread of a worker.

    Raises
    ------
    Lost
        If the process ends, or the call takes too long.
    KgcpError
        If the worker has other versions, does not see a folder, or cannot start a process.
    Exception
        As the function does.
    """
    _require_same_versions(context)
    for folder in context.folders:
        if not folder.is_dir():
            raise KgcpError(
                f"{folder}: is not seen by the worker {_address()}; mount it there under the same"
                " name"
            )
    return _process(context).call(function, *args)


def _require_same_versions(context: JobContext) -> None:
    own = _own_versions()
    differing = [name for name, value in context.versions.items() if own.get(name) != value]
    if differing:
        name = differing[0]
        raise KgcpError(
            f"the worker {_address()}: has {name} {own.get(name)}, not {context.versions[name]},"
            " and might give other results; install the same versions everywhere"
        )


_own_versions = cache(versions)


def _address() -> str:
    from distributed import get_worker

    return str(get_worker().address)


def _process(context: JobContext) -> WorkerProcess:
    thread = threading.get_ident()
    run, process = _processes.get(thread, (None, None))
    if process is None or run != context.run:
        if process is not None:
            process.end()  # of a run that had no time to say that it ends
        # Dask's workers may have no children, which might outlive them. Ours end with their parent.
        multiprocessing.current_process().daemon = False
        process = WorkerProcess(context.limit_s)
        _processes[thread] = context.run, process
    return process


def release(run: str) -> None:
    """End all processes of a run."""
    for thread, (owner, process) in tuple(_processes.items()):
        if owner == run:
            del _processes[thread]
            process.end()
