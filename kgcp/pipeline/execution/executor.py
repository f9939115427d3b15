"""Workers for the frames: this process, others of this machine, or those of a cluster."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TypeVar

from kgcp.io.images.remote import StoredFolder
from kgcp.pipeline.execution.dask_client import connected
from kgcp.pipeline.execution.local_processes import Preparation, SupervisedProcessPool
from kgcp.pipeline.execution.profiling import profiled
from kgcp.pipeline.execution.resilient_map import (
    SerialExecutor,
    TaskFailure,
    resilient_map,
    usable_cores,
)
from kgcp.pipeline.execution.signals import defer_interrupts

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class WorkerPool:
    """The workers of a run."""

    jobs: int  # number of workers; 0: this process
    executor: Executor
    # functions whose callees are timed as stages; empty: nothing is timed
    callers: tuple[Callable[..., object], ...]
    stages_s: Counter[str]  # sums of the workers' times by stage [s]

    def import_meanwhile(self, *modules: str) -> None:
        """Import what this process needs later, while the workers work on the first frames."""
        if self.jobs:
            with defer_interrupts():  # a thread leaves Ctrl-C to this one
                threading.Thread(target=lambda: [*map(import_module, modules)]).start()

    def map(
        self, function: Callable[[_Item], _Result], items: Iterable[_Item]
    ) -> Generator[tuple[_Item, _Result | TaskFailure]]:
        """Yield items and results in the order in which they are completed."""
        if not self.callers:
            yield from resilient_map(function, items, self.executor, self.jobs)
            return
        timed = partial(profiled, self.callers, function)
        with closing(resilient_map(timed, items, self.executor, self.jobs)) as results:
            for item, result in results:
                if isinstance(result, TaskFailure):
                    yield item, result
                else:
                    value, stages_s = result
                    self.stages_s.update(stages_s)
                    yield item, value


@contextmanager
def open_pool(
    jobs: int | None,
    limit_s: float,
    scheduler: str | None,
    frames: Path | StoredFolder,
    callers: tuple[Callable[..., object], ...] = (),
    preparation: Preparation | None = None,
) -> Iterator[WorkerPool]:
    """Provide workers until the block ends.

    Parameters
    ----------
    jobs : int or None
        0: this process; None: the usable cores, or all threads that the scheduler has.
    limit_s : float
        Time limit for one call [s]; there is none in this process.
    scheduler : str or None
        As `kgcp.pipeline.execution.dask_client.connected` takes it; None: this machine works alone.
    frames : Path or StoredFolder
        Place of the frames; other machines must see a folder under the same absolute path.
    callers : tuple of callable
        Functions whose callees are timed; see `profiled`.
    preparation : Preparation, optional
        Preparation of each process of this machine.

    Raises
    ------
    KgcpError
        If the scheduler cannot be used.
    """
    if scheduler is None:
        jobs = usable_cores() if jobs is None else jobs
        executor = SupervisedProcessPool(jobs, limit_s, preparation) if jobs else SerialExecutor()
        with executor:
            yield WorkerPool(jobs, executor, callers, Counter())
        return
    folders = (frames,) if isinstance(frames, Path) else ()
    with connected(scheduler, limit_s, folders) as cluster:
        yield WorkerPool(jobs or cluster.jobs, cluster, callers, Counter())
