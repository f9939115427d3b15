"""Many frames, many processes, one ordered table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path

import cv2

from kgcp import __version__
from kgcp.errors import KgcpError, Rejection, Status
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera, TimeReference
from kgcp.io.columns import DETECTION_COLUMNS, SCHEMA_VERSION
from kgcp.io.detections import FrameResult, detection_rows
from kgcp.io.exif import Exif
from kgcp.io.flight import Flight
from kgcp.io.frames import list_frames, read_exif, read_grey
from kgcp.io.frametimes import read_times
from kgcp.io.poses import read_flight_poses
from kgcp.io.tables import write_table
from kgcp.settings import DetectSettings
from kgcp.target.common import common_uncertainty
from kgcp.target.layout import Target
from kgcp.target.measure import measure_frame
from kgcp.target.observation import Miss, Outcome
from kgcp.target.prior import NormalPrior, normal_priors
from kgcp.workers import ordered_map

_FRAMES_PER_TASK = 4  # small enough to keep the progress bar moving and the workers evenly busy


@dataclass(frozen=True, slots=True)
class FrameTask:
    """What a worker needs to know to examine any frame of a flight."""

    frames_folder: Path
    camera: Camera
    calibration_covariance: CalibrationCovariance | None
    targets: tuple[Target, ...]
    settings: DetectSettings


@dataclass(frozen=True, slots=True)
class FrameNote:
    """What a worker needs to know about one frame.

    Attributes
    ----------
    frame : str
        Path relative to the frames folder.
    time_s : float or None
        From the times file, of the camera's `time_reference`, Unix UTC [s]; None: EXIF decides.
    prior : NormalPrior or None
        Of the normal of the plate on the vehicle; None: nothing is known of it.
    """

    frame: str
    time_s: float | None
    prior: NormalPrior | None


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
    exif_times_in_whole_seconds : int
        Frames whose time is EXIF's, if all of these times are whole seconds; else 0.
    frames_without_attitude : int
        Frames whose camera attitude is not known, so that a level plate tells nothing about them;
        0 where the plate is not said to be level.
    """

    frames: int
    status: Mapping[str, int]
    reasons: Mapping[str, int]
    frames_without_time: int
    times_without_frame: int
    exif_times_in_whole_seconds: int
    frames_without_attitude: int


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
        If there are no frames, the times file or that of the reference poses is bad, or `out`
        cannot be written.
    """
    frames = list_frames(flight.frames_folder)
    if not frames:
        raise KgcpError(
            f"{flight.frames_folder}: holds no images; put the frames there or correct"
            " [frames] folder in flight.toml"
        )
    times = {}
    if flight.times_file is not None:
        times = read_times(flight.times_file, frames, flight.times_format)
    notes = _take_notes(flight, frames, times)
    task = FrameTask(
        flight.frames_folder,
        flight.camera,
        flight.calibration_covariance,
        flight.targets,
        settings,
    )
    results = []
    for result in examine_frames(task, notes, jobs=jobs):
        on_frame(result)
        results.append(result)
    write_table(
        out / "detections.parquet",
        DETECTION_COLUMNS,
        chain.from_iterable(map(detection_rows, results)),
        _provenance(flight, settings),
    )
    is_level = flight.vehicle is not None and flight.vehicle.level_sd_deg is not None
    without_attitude = sum(note.prior is None for note in notes) if is_level else 0
    return _summarise(results, times, without_attitude)


def _take_notes(
    flight: Flight, frames: Sequence[str], times: Mapping[str, float]
) -> list[FrameNote]:
    """Return what is known of each frame before it is read.

    Reference poses are mostly made after the detections: a file that is not there yet is no error.
    """
    priors: Sequence[NormalPrior | None] = [None] * len(frames)
    if flight.vehicle is not None and flight.vehicle.level_sd_deg is not None:
        path = flight.reference_file
        priors = normal_priors(
            frames,
            read_flight_poses(flight) if path is not None and path.is_file() else None,
            level_sd_deg=flight.vehicle.level_sd_deg,
            plumb_sd_deg=flight.plumb_sd_deg,
        )
    return [
        FrameNote(frame, times.get(frame), prior)
        for frame, prior in zip(frames, priors, strict=True)
    ]


def examine_frames(
    task: FrameTask, notes: Sequence[FrameNote], *, jobs: int
) -> Iterator[FrameResult]:
    """Yield the result of every frame, in the order given, from a pool of `jobs` processes."""
    return ordered_map(
        _examine_in_worker,
        notes,
        jobs=jobs,
        start=_start_worker,
        start_arguments=(task,),
        items_per_task=_FRAMES_PER_TASK,
    )


def examine_frame(task: FrameTask, note: FrameNote) -> FrameResult:
    """Read and measure one frame; whatever a frame can do wrong becomes its result."""
    path = task.frames_folder / note.frame
    exif = read_exif(path)
    outcomes: tuple[Outcome, ...]
    try:
        grey = read_grey(path, task.camera)
        measured = measure_frame(grey, task.camera, task.targets, task.settings, note.prior)
        outcomes = tuple(_with_common_uncertainty(task, outcome) for outcome in measured)
    except Rejection as rejection:
        outcomes = tuple(
            Miss(target.name, rejection.reason, rejection.detail) for target in task.targets
        )
    time_s = exif.time_s if note.time_s is None else note.time_s
    reference = task.camera.time_reference
    if time_s is not None and reference is not TimeReference.MIDDLE:
        is_readable = not any(_is_unreadable(outcome) for outcome in outcomes)
        time_s = _mid_exposure_s(time_s, exif, reference, path) if is_readable else None
    return FrameResult(note.frame, time_s, exif, outcomes)


def _is_unreadable(outcome: Outcome) -> bool:
    return isinstance(outcome, Miss) and outcome.reason.status is Status.UNREADABLE


def _mid_exposure_s(time_s: float, exif: Exif, reference: TimeReference, path: Path) -> float:
    if exif.exposure_time_s is None:
        raise KgcpError(
            f"{path}: has no exposure time in EXIF, which [camera] time_reference ="
            f" '{reference.value}' in flight.toml needs; write EXIF into the frames, or give times"
            " of mid-exposure and delete time_reference"
        )
    return time_s + reference.to_middle_s(exif.exposure_time_s)


def _with_common_uncertainty(task: FrameTask, outcome: Outcome) -> Outcome:
    if isinstance(outcome, Miss):
        return outcome
    ring = next(target.ring for target in task.targets if target.name == outcome.target)
    common = common_uncertainty(task.camera, task.calibration_covariance, ring, outcome.pose)
    return replace(outcome, common=common)


_worker_task: FrameTask | None = None  # set once per process: sent with every frame it would cost


def _start_worker(task: FrameTask) -> None:
    global _worker_task  # noqa: PLW0603 - the only state a pool's initializer can leave behind
    _worker_task = task
    cv2.setNumThreads(0)  # the processes are the parallelism


def _examine_in_worker(note: FrameNote) -> FrameResult:
    if _worker_task is None:
        raise RuntimeError("worker used before it was started")
    return examine_frame(_worker_task, note)


def _provenance(flight: Flight, settings: DetectSettings) -> dict[str, str]:
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "settings": json.dumps(asdict(settings), sort_keys=True),
        "flight_toml": flight.toml_text,
    }


def _summarise(
    results: Sequence[FrameResult], times: Mapping[str, float], frames_without_attitude: int
) -> SurveySummary:
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
        exif_times_in_whole_seconds=_whole_seconds(results, times),
        frames_without_attitude=frames_without_attitude,
    )


def _whole_seconds(results: Sequence[FrameResult], times: Mapping[str, float]) -> int:
    """Count the times from EXIF if none of them has a fraction of a second."""
    from_exif = [
        result.exif.time_s
        for result in results
        if result.frame not in times and result.exif.time_s is not None
    ]
    return len(from_exif) if all(time_s.is_integer() for time_s in from_exif) else 0
