"""Many frames, many processes, one ordered table."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

from kgcp import __version__
from kgcp.errors import KgcpError, Status
from kgcp.examine import (
    Debug,
    FrameNote,
    FrameTask,
    SecondLook,
    examine_again,
    examine_frames,
)
from kgcp.expectations import expectations, with_expectations
from kgcp.io.columns import DETECTION_COLUMNS, SCHEMA_VERSION
from kgcp.io.detections import FrameResult, detection_rows
from kgcp.io.flight import Flight
from kgcp.io.frames import list_frames
from kgcp.io.frametimes import read_times
from kgcp.io.poses import read_flight_poses
from kgcp.io.tables import write_table
from kgcp.settings import DetectSettings
from kgcp.target.expected import Expectation
from kgcp.target.observation import Miss, Observation, is_unreadable
from kgcp.target.prior import NormalPrior, normal_priors


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
    guided : int
        Rows measured by a second look only.
    guide_problem : str or None
        Why reference poses and trajectory could not say where to look again, if they could not.
    """

    frames: int
    status: Mapping[str, int]
    reasons: Mapping[str, int]
    frames_without_time: int
    times_without_frame: int
    exif_times_in_whole_seconds: int
    frames_without_attitude: int
    guided: int
    guide_problem: str | None


def detect_flight(
    flight: Flight,
    settings: DetectSettings,
    out: Path,
    *,
    jobs: int,
    on_frame: Callable[[FrameResult], None],
    debug: Debug | None = None,
) -> SurveySummary:
    """Examine every frame of a flight and write `detections.parquet`.

    Frames without a target are looked at again where the others say that it must be.

    Parameters
    ----------
    flight : Flight
    settings : DetectSettings
    out : Path
        Folder of the results.
    jobs : int
        Worker processes; 1 works in this one. The table does not depend on it.
    on_frame : callable
        Called with each frame's result, in the frames' order, then with those of second looks.
    debug : Debug, optional
        Pictures to draw.

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
        debug,
    )
    results = []
    for result in examine_frames(task, notes, jobs=jobs):
        on_frame(result)
        results.append(result)
    guide_problem = None
    if settings.is_guided:
        expected, guide_problem = expectations(flight, results)
        looks = _second_looks(flight, notes, results, expected)
        rows = {result.frame: row for row, result in enumerate(results)}
        for result in examine_again(task, looks, jobs=jobs):
            on_frame(result)
            results[rows[result.frame]] = result
        results = list(map(with_expectations, results, expected))
    write_table(
        out / "detections.parquet",
        DETECTION_COLUMNS,
        chain.from_iterable(map(detection_rows, results)),
        _provenance(flight, settings),
    )
    is_level = flight.vehicle is not None and flight.vehicle.level_sd_deg is not None
    without_attitude = sum(note.prior is None for note in notes) if is_level else 0
    return _summarise(results, times, without_attitude, guide_problem)


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


def _second_looks(
    flight: Flight,
    notes: Sequence[FrameNote],
    results: Sequence[FrameResult],
    expected: Sequence[Mapping[str, Expectation]],
) -> list[SecondLook]:
    """Return the readable frames in which a missing target must be visible."""
    looks = []
    for note, result, here in zip(notes, results, expected, strict=True):
        visible = {name: one for name, one in here.items() if one.is_visible(flight.camera)}
        if visible and not any(map(is_unreadable, result.outcomes)):
            looks.append(SecondLook(note, result, visible))
    return looks


def _provenance(flight: Flight, settings: DetectSettings) -> dict[str, str]:
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "settings": json.dumps(asdict(settings), sort_keys=True),
        "flight_toml": flight.toml_text,
    }


def _summarise(
    results: Sequence[FrameResult],
    times: Mapping[str, float],
    frames_without_attitude: int,
    guide_problem: str | None,
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
        guided=sum(isinstance(one, Observation) and one.is_guided for one in outcomes),
        guide_problem=guide_problem,
    )


def _whole_seconds(results: Sequence[FrameResult], times: Mapping[str, float]) -> int:
    """Count the times from EXIF if none of them has a fraction of a second."""
    from_exif = [
        result.exif.time_s
        for result in results
        if result.frame not in times and result.exif.time_s is not None
    ]
    return len(from_exif) if all(time_s.is_integer() for time_s in from_exif) else 0
