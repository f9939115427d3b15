"""CPU time of decoding, of the search and of the complete detection, frame by frame."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

import cv2

from kgcp.geometry.camera import Camera
from kgcp.io.images.frames import read_grey
from kgcp.measurement.frame import examine
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import Measurement
from kgcp.measurement.search.candidates import find_rings
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target

if TYPE_CHECKING:  # imports at run time would add to the memory that is measured
    from benchmarks.speed.sources import Source

Result = TypeVar("Result")

_REPEATS = 3  # the smallest counts, since other work of the machine only adds time
HEADER = "set                     targets  frames   Mpx  decode ms   search   whole  median"


@dataclass(frozen=True, slots=True)
class FrameCost:
    """CPU times of one frame [s].

    Attributes
    ----------
    decode_s, search_s, measure_s : float
        Decoding the file; the search for rings alone; search and measurement together.
    found : int
        Number of targets that were measured.
    """

    pixels: int
    decode_s: float
    search_s: float
    measure_s: float
    found: int


@dataclass(frozen=True, slots=True)
class Costs:
    """The frames of one line of the table.

    Attributes
    ----------
    name, targets : str
        Source of the frames, and whether a target was measured in them.
    """

    name: str
    targets: str
    frames: tuple[FrameCost, ...]

    def mean(self, value: Callable[[FrameCost], float]) -> float:
        """Return the mean of a value over the frames."""
        return sum(map(value, self.frames)) / len(self.frames)

    @property
    def decode_s(self) -> float:
        """Mean CPU time of decoding [s]."""
        return self.mean(lambda cost: cost.decode_s)

    @property
    def search(self) -> float:
        """CPU time of the search, divided by that of decoding."""
        return self.mean(lambda cost: cost.search_s) / self.decode_s

    @property
    def whole(self) -> float:
        """CPU time of decoding, search and measurement, divided by that of decoding."""
        return 1.0 + self.mean(lambda cost: cost.measure_s) / self.decode_s

    @property
    def typical(self) -> float:
        """The same ratio for each frame: the median over the frames."""
        return 1.0 + median(cost.measure_s / cost.decode_s for cost in self.frames)


def use_one_opencv_thread() -> None:
    """Let OpenCV use one thread, as in the workers of `kgcp detect`."""
    cv2.setNumThreads(0)


def peak_memory_bytes() -> int:
    """Return the peak memory of this process alone; on Linux, `getrusage` includes its parent's."""
    if sys.platform != "linux":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def cost_and_memory(
    path: Path, camera: Camera, targets: tuple[Target, ...]
) -> tuple[FrameCost, int]:
    """Time one frame; return its costs, and the peak memory of the process [bytes]."""
    cost_of(path, camera, targets)  # compiles
    return cost_of(path, camera, targets), peak_memory_bytes()


def cost_of(
    path: Path,
    camera: Camera,
    targets: tuple[Target, ...],
    priors: Mapping[str, PlatePrior] = MappingProxyType({}),
) -> FrameCost:
    """Time the steps of one frame; `priors` is what a run knows of the targets by then."""
    settings = DetectSettings()
    costs = []
    for _ in range(_REPEATS):  # in turn, since decoding alone in a loop is faster than in a run
        decode_s, grey = _timed(partial(read_grey, path, camera))
        search_s, _ = _timed(partial(find_rings, grey, settings))
        measure_s, seen = _timed(partial(examine, grey, camera, targets, settings, priors))
        found = sum(isinstance(outcome, Measurement) for outcome in seen.outcomes)
        costs.append(FrameCost(grey.size, decode_s, search_s, measure_s, found))
        del grey  # workers do not have two frames at a time
    return FrameCost(
        costs[0].pixels,
        min(cost.decode_s for cost in costs),
        min(cost.search_s for cost in costs),
        min(cost.measure_s for cost in costs),
        costs[0].found,
    )


def _timed(function: Callable[[], Result]) -> tuple[float, Result]:
    begin_s = time.process_time()
    result = function()
    return time.process_time() - begin_s, result


def cost_of_all(source: Source) -> Iterable[Costs]:
    """Time the frames of a source, apart for those with and without a measured target."""
    flight = source.flight
    paths = [flight.frames_folder / name for name in source.frames]
    cost_of(paths[0], flight.camera, flight.targets)  # compiles
    costs = [cost_of(path, flight.camera, flight.targets, source.priors) for path in paths]
    for targets, chosen in (("with", _found(costs)), ("without", _missed(costs))):
        if chosen:
            yield Costs(source.name, targets, tuple(chosen))


def print_costs(sources: Iterable[Source], count: int) -> Iterable[FrameCost]:
    """Print the lines of sources, and yield the costs of `count` frames spread over each."""
    for source in sources:
        for costs in cost_of_all(source.spread(count)):
            print(cost_line(costs), flush=True)
            yield from costs.frames


def _found(costs: Sequence[FrameCost]) -> list[FrameCost]:
    return [cost for cost in costs if cost.found]


def _missed(costs: Sequence[FrameCost]) -> list[FrameCost]:
    return [cost for cost in costs if not cost.found]


def cost_line(costs: Costs) -> str:
    """Return one line of the table."""
    megapixels = 1e-6 * costs.mean(lambda cost: cost.pixels)
    return (
        f"{costs.name:24s}{costs.targets:7s}{len(costs.frames):8d}{megapixels:6.1f}"
        f"{1e3 * costs.decode_s:11.1f}{costs.search:9.2f}{costs.whole:8.2f}{costs.typical:8.2f}"
    )
