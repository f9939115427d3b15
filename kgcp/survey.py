"""Many frames, many processes, one ordered table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

import cv2

from kgcp import __version__
from kgcp.errors import KgcpError, Rejection, Status
from kgcp.geometry.camera import Camera
from kgcp.io.columns import DETECTION_COLUMNS, SCHEMA_VERSION
from kgcp.io.detections import FrameResult, detection_rows
from kgcp.io.flight import Flight
from kgcp.io.frames import list_frames, read_exif, read_frame_times, read_grey
from kgcp.io.tables import write_table
from kgcp.settings import DetectSettings
from kgcp.target.layout import Target
from kgcp.target.measure import measure_frame
from kgcp.target.observation import Miss, Outcome
from kgcp.workers import ordered_map

_FRAMES_PER_TASK = 4  # small enough to keep the progress bar moving and the workers evenly busy


@dataclass(frozen=True, slots=True)
class FrameTask:
    """What a worker needs to know to examine any frame of a flight."""

    frames_folder: Path
    camera: Camera
    targets: tuple[Target, ...]
    settings: DetectSettings


@dataclass(frozen=True, slots=True)
class SurveySummary:
    """Counts over a flight.

    Attributes
    ----------
    frames : int
        Frames examined.
    status : dict of int
        Rows per status.
    reasons : dict of int
        Rows per reason, most frequent first.
    frames_without_time : int
        Frames that neither the times file nor EXIF gives a time.
    times_without_frame : int
        Entries of the times file that name no frame.
    """

    frames: int
    status: Mapping[str, int]
    reasons: Mapping[str, int]
    frames_without_time: int
    times_without_frame: int


def detect_flight(
    flight: Flight,
    settings: DetectSettings,
    out: Path,
    *,
    jobs: int,
    on_frame: Callable[[FrameResult], None],
) -> SurveySummary:
    """Examine every frame of a flight and write `detections.parquet`.

    Parameters
    ----------
    flight : Flight
    settings : DetectSettings
    out : Path
        Folder of the results.
    jobs : int
        Worker processes; 1 works in this one. The table does not depend on it.
    on_frame : callable
        Called with each frame's result, in the frames' order.

    Raises
    ------
    KgcpError
        If there are no frames, the times file is bad, or `out` cannot be written.
    """
    frames = list_frames(flight.frames_folder)
    if not frames:
        raise KgcpError(
            f"{flight.frames_folder}: holds no images; put the frames there or correct"
            " [frames] folder in flight.toml"
        )
    times = {} if flight.times_file is None else read_frame_times(flight.times_file)
    task = FrameTask(flight.frames_folder, flight.camera, flight.targets, settings)
    results = []
    for result in examine_frames(task, frames, times, jobs=jobs):
        on_frame(result)
        results.append(result)
    write_table(
        out / "detections.parquet",
        DETECTION_COLUMNS,
        chain.from_iterable(map(detection_rows, results)),
        _provenance(flight, settings),
    )
    return _summarise(results, times)


def examine_frames(
    task: FrameTask, frames: Sequence[str], times: Mapping[str, float], *, jobs: int
) -> Iterator[FrameResult]:
    """Yield the result of every frame, in the order given, from a pool of `jobs` processes."""
    return ordered_map(
        _examine_in_worker,
        [(frame, times.get(frame)) for frame in frames],
        jobs=jobs,
        start=_start_worker,
        start_arguments=(task,),
        items_per_task=_FRAMES_PER_TASK,
    )


def examine_frame(task: FrameTask, frame: str, time_s: float | None) -> FrameResult:
    """Read and measure one frame; whatever a frame can do wrong becomes its result.

    Parameters
    ----------
    task : FrameTask
    frame : str
        Path relative to the frames folder.
    time_s : float or None
        Mid-exposure from the times file, Unix UTC [s]; None: EXIF decides.
    """
    path = task.frames_folder / frame
    exif = read_exif(path)
    outcomes: tuple[Outcome, ...]
    try:
        grey = read_grey(path, task.camera)
        outcomes = measure_frame(grey, task.camera, task.targets, task.settings)
    except Rejection as rejection:
        outcomes = tuple(
            Miss(target.name, rejection.reason, rejection.detail) for target in task.targets
        )
    return FrameResult(frame, exif.time_s if time_s is None else time_s, exif, outcomes)


_worker_task: FrameTask | None = None  # set once per process: sent with every frame it would cost


def _start_worker(task: FrameTask) -> None:
    global _worker_task  # noqa: PLW0603 - the only state a pool's initializer can leave behind
    _worker_task = task
    cv2.setNumThreads(0)  # the processes are the parallelism


def _examine_in_worker(frame_and_time: tuple[str, float | None]) -> FrameResult:
    if _worker_task is None:
        raise RuntimeError("worker used before it was started")
    return examine_frame(_worker_task, *frame_and_time)


def _provenance(flight: Flight, settings: DetectSettings) -> dict[str, str]:
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "settings": json.dumps(asdict(settings), sort_keys=True),
        "flight_toml": flight.toml_text,
    }


def _summarise(results: Sequence[FrameResult], times: Mapping[str, float]) -> SurveySummary:
    outcomes = [outcome for result in results for outcome in result.outcomes]
    reasons = Counter(outcome.reason for outcome in outcomes if isinstance(outcome, Miss))
    status = Counter(
        outcome.reason.status if isinstance(outcome, Miss) else Status.MEASURED
        for outcome in outcomes
    )
    return SurveySummary(
        frames=len(results),
        status={kind.value: status[kind] for kind in Status},
        reasons={reason.value: count for reason, count in reasons.most_common()},
        frames_without_time=sum(result.time_s is None for result in results),
        times_without_frame=len(times.keys() - {result.frame for result in results}),
    )
