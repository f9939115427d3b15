"""Who looks at the frames: this process, others of this machine, or those of a cluster."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from kgcp.io.images.remote import StoredFolder
from kgcp.pipeline.execution.dask_client import connected
from kgcp.pipeline.execution.local_processes import LocalPool
from kgcp.pipeline.execution.profiling import profiled
from kgcp.pipeline.execution.resilient_map import Inline, Loss, careful_map, usable_cores

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Crew:
    """Who does the work.

    Attributes
    ----------
    jobs : int
        Worker processes; 0 works in this one.
    limit_s : float
        Time for one look at one frame [s]; no limit in this process.
    stages_s : Counter of float, or None
        Takes the time of all workers by stage [s]; None: it is not measured.
    elsewhere : callable or None
        Makes an executor of other machines' workers, which raises `Overdue`; None: they are
        processes of this one.
    """

    jobs: int
    limit_s: float
    stages_s: Counter[str] | None = None
    elsewhere: Callable[[], Executor] | None = None

    def map(
        self, function: Callable[[_Item], _Result], items: Iterable[_Item]
    ) -> Generator[tuple[_Item, _Result | Loss]]:
        """Yield items and results as they come."""
        if self.stages_s is None:
            yield from self._map(function, items)
            return
        with closing(self._map(partial(profiled, function), items)) as results:
            for item, result in results:
                if isinstance(result, Loss):
                    yield item, result
                else:
                    self.stages_s.update(result.stages_s)
                    yield item, result.result

    def _map(
        self, function: Callable[[_Item], _Result], items: Iterable[_Item]
    ) -> Generator[tuple[_Item, _Result | Loss]]:
        limit_s = self.limit_s if self.elsewhere is None else math.inf  # it is told who was late
        return careful_map(function, items, start=self._start, jobs=self.jobs, limit_s=limit_s)

    def _start(self, jobs: int) -> Executor:
        if self.elsewhere is not None:
            return self.elsewhere()
        return Inline() if self.jobs == 0 else LocalPool(jobs, self.limit_s)


@contextmanager
def hired(
    jobs: int | None,
    limit_s: float,
    scheduler: str | None,
    frames: Path | StoredFolder,
    *,
    is_profiled: bool,
) -> Iterator[Crew]:
    """Have a crew until the block ends.

    Parameters
    ----------
    jobs : int or None
        None: the usable cores, or all threads that the scheduler has.
    limit_s : float
    scheduler : str or None
        As `kgcp.pipeline.execution.dask_client.connected` takes it; None: this machine works alone.
    frames : Path or StoredFolder
        Where they are; other machines must see a folder under the same, absolute, name.
    is_profiled : bool

    Raises
    ------
    KgcpError
        If the scheduler is of no use.
    """
    stages_s: Counter[str] | None = Counter() if is_profiled else None
    if scheduler is None:
        yield Crew(usable_cores() if jobs is None else jobs, limit_s, stages_s)
        return
    folders = (frames,) if isinstance(frames, Path) else ()
    with connected(scheduler, limit_s, folders) as cluster:
        yield Crew(jobs or cluster.jobs, limit_s, stages_s, cluster.executor)
