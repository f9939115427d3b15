"""The bias study of a flight, and the files of its report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from kgcp.errors import KgcpError, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.selection import Selection
from kgcp.io.files.atomic import remove, write_bytes
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, require_flight
from kgcp.io.images.frames import read_grey
from kgcp.io.images.remote import StoredFolder, at_hand
from kgcp.io.tables.detections import (
    Outcomes,
    read_attempts,
    read_learnt_imaging,
    read_outcomes,
    read_settings,
)
from kgcp.io.tables.gcps import BIAS_COLUMNS, bias_row
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.provenance import derived_provenance
from kgcp.io.tables.staleness import are_by_orient
from kgcp.measurement.image_model.window import contour_px
from kgcp.pipeline.exclude import FrameAndTarget, without_excluded
from kgcp.pipeline.execution.signals import defer_interrupts
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.flight_inputs import FlightInputs, naming_causes
from kgcp.pipeline.workspace import DETECTIONS, require_outside_frames, results_folder
from kgcp.quality.advice import agrees
from kgcp.quality.bias_study import BiasStudy, study_bias
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.consistency import Consistency
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.report.bias.figures import draw_figures
from kgcp.report.bias.numbers import SPREAD, BiasNumbers, bias_numbers, evenly
from kgcp.report.bias.origin import agreement, facts, headline
from kgcp.report.bias.page import Content, render_page
from kgcp.report.bias.reexposure import Reexposed, measure_again
from kgcp.report.bias.summary import Json, summary_of
from kgcp.report.bias.verdict import Verdict, assess
from kgcp.report.bias.wording import learnt_sentence
from kgcp.report.ring_picture import RingView, draw_closeup
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget

REEXPOSED_FRAMES = 12

FIGURE_FILES = {
    "error": "bias_error.png",
    "camera": "bias_camera.png",
    "rate": "bias_detection_rate.png",
    "exposure": "bias_exposure.png",
    "edges": "bias_edges.png",
    "reexposure": "bias_reexposure.png",
    "standardised": "bias_standardised.png",
    "time": "bias_time.png",
    "image": "bias_image.png",
    "map": "bias_map.png",
}


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The numbers, the verdict and the files of a report."""

    numbers: Json
    verdict: Verdict
    files: tuple[Path, ...]

    def summary(self) -> Json:
        """Return all numbers for machines, and the paths of the files."""
        return {**self.numbers, "files": [str(path) for path in self.files]}


@dataclass(frozen=True, slots=True, eq=False)
class FlightBias:
    """Comparison of the measured distances of a flight with its reference poses.

    Attributes
    ----------
    settings : DetectSettings
        Settings with which the distances were measured.
    study : BiasStudy
        The comparison of every measurement.
    provenance : mapping of str
        Metadata of bias.parquet: what the comparisons were made from.
    doubts : tuple of Doubt
        What does not fit, with its likely cause; grave doubts come first.
    outcomes : Outcomes or None
        Counts of the frames by outcome; None: unknown.
    consistency : Consistency or None
        Agreement of vehicle and camera; None: too few frames to compare.
    learnt : LearntImaging or None
        Properties of the camera learnt from all frames together; None: nothing was learnt.
    left_out : int
        Measurements that the user excluded.
    """

    flight: Flight
    settings: DetectSettings
    study: BiasStudy
    provenance: Mapping[str, str]
    doubts: tuple[Doubt, ...] = ()
    outcomes: Outcomes | None = None
    consistency: Consistency | None = None
    learnt: LearntImaging | None = None
    left_out: int = 0

    def summary(self) -> Json:
        """Return the numbers of `bias_summary.json`, but without those of re-exposed frames."""
        numbers = bias_numbers(self.study)
        return summary_of(numbers, self._verdict(numbers), self.doubts, [])

    def to_dataframe(self) -> pd.DataFrame:
        """Return the comparisons as a table with the columns of `bias.parquet`."""
        names = [column.name for column in BIAS_COLUMNS]
        rows = [bias_row(pair, self.study.method) for pair in self.study.measured]
        return pd.DataFrame(rows, columns=names)

    @single_threaded()
    def write_report(
        self,
        folder: Path | str | None = None,
        *,
        reexpose: int = REEXPOSED_FRAMES,
        stored_frames: StoredFolder | None = None,
    ) -> Report:
        """Write bias.parquet, bias_summary.json, the figures and bias_report.html.

        Parameters
        ----------
        folder : Path, optional
            By default the flight's results folder.
        reexpose : int
            Number of frames to measure again with darker and brighter grey values.
        stored_frames : StoredFolder, optional
            Where the frames are, if not in the flight's folder.

        Raises
        ------
        KgcpError
            If no measurement can be compared, the folder is among the frames, which its figures
            would join, or a file cannot be written.
        """
        study, flight = self.study, self.flight
        folder = results_folder(flight.folder) if folder is None else Path(folder)
        require_outside_frames(flight, folder, "report", option="out")
        if not study.trusted:
            with naming_causes(self.doubts):
                raise KgcpError(
                    f"none of {len(study.measured)} measurements is where a reference pose and"
                    " the trajectory predict the target; check [reference] poses, [vehicle]"
                    " trajectory and crs"
                )
        content = self._content(stored_frames or flight.frames_folder, reexpose)
        files = {FIGURE_FILES[name]: figure.png for name, figure in content.pictures.items()}
        text = json.dumps(content.summary, indent=1, allow_nan=False)
        files["bias_summary.json"] = f"{text}\n".encode()
        files["bias_report.html"] = render_page(content).encode()
        table = folder / "bias.parquet"
        rows = (bias_row(pair, study.method) for pair in study.measured)
        for name in {*FIGURE_FILES.values(), *files}:
            remove(folder / name)  # of an earlier run: it does not show these numbers
        write_table(table, BIAS_COLUMNS, rows, self.provenance)
        for name, data in files.items():
            write_bytes(folder / name, data)
        paths = (table, *(folder / name for name in files))
        return Report(content.summary, content.verdict, paths)

    def _verdict(self, numbers: BiasNumbers, reexposed: Sequence[Reexposed] = ()) -> Verdict:
        consistency = self.consistency
        is_agreed = consistency is None or agrees(consistency)
        return assess(numbers, reexposed, agrees=is_agreed, doubts=self.doubts)

    def _content(self, frames: Path | StoredFolder, reexpose: int) -> Content:
        numbers = bias_numbers(self.study)
        shown = [*evenly(numbers.data.distance_m, SPREAD), *numbers.worst]
        again = evenly(numbers.data.distance_m, reexpose)
        closeups, reexposed = _closeups_and_reexposures(
            numbers, self.flight, frames, self.settings, shown, again
        )
        verdict = self._verdict(numbers, reexposed)
        consistency = self.consistency
        return Content(
            name=self.flight.name,
            headline=headline(self.flight, self.outcomes),
            facts=facts(
                self.flight, self.settings, self.outcomes, self.provenance, left_out=self.left_out
            ),
            agreement=agreement(consistency, self.doubts),
            doubts=self.doubts,
            numbers=numbers,
            verdict=verdict,
            learnt="" if self.learnt is None else learnt_sentence(self.learnt),
            pictures=draw_figures(numbers, self.flight.camera, reexposed, self.learnt),
            rows=[bias_row(pair, self.study.method) for pair in numbers.compared],
            closeups=closeups,
            reexposed=reexposed,
            summary=summary_of(numbers, verdict, self.doubts, reexposed),
        )


@single_threaded()
def bias_study(
    flight: Flight,
    detections: Path | str | None = None,
    *,
    excluded: Sequence[FrameAndTarget] = (),
) -> FlightBias:
    """Compare the distances of a flight's detections with its reference poses.

    Parameters
    ----------
    detections : Path, optional
        The table that `detect_flight` wrote; by default that of the flight's results folder.
    excluded : sequence of (str, str)
        What to leave out, as in `Selection`.

    Raises
    ------
    KgcpError
        If flight.toml names no reference poses, or a file is missing or unreadable.
    """
    require_flight(flight)
    table = results_folder(flight.folder) / DETECTIONS if detections is None else Path(detections)
    pairs = Selection(excluded=tuple(excluded)).excluded
    read = read_attempts(table, flight)
    attempts = without_excluded(read, pairs, table)
    settings = read_settings(table)
    data = FlightData(flight, [attempt.frame for attempt in attempts])
    inputs = FlightInputs.detected(flight, data, attempts)
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    with naming_causes(inputs.plausibility):
        poses, positions = data.reference_poses, data.target_positions
        study = study_bias(
            attempts,
            poses,
            positions,
            flight.camera,
            flight.all_targets,
            settings.method,
            inputs.motions(sightings),
            _orienting_targets(flight),
        )
    consistency, doubts = inputs.compared(sightings)
    choices = {"excluded": pairs} if pairs else {}
    provenance = derived_provenance(flight, table, choices, has_reference=True)
    return FlightBias(
        flight=flight,
        settings=settings,
        study=study,
        provenance=provenance,
        doubts=doubts,
        outcomes=read_outcomes(table),
        consistency=consistency,
        learnt=read_learnt_imaging(table),
        left_out=sum(attempt.sighting is not None for attempt in read) - len(sightings),
    )


def _orienting_targets(flight: Flight) -> tuple[str, ...]:
    """Return the names of the static targets if the reference poses were computed from them."""
    if flight.reference is None or not are_by_orient(flight.reference.file, flight):
        return ()
    return tuple(target.name for target in flight.static_targets)


def _closeups_and_reexposures(
    numbers: BiasNumbers,
    flight: Flight,
    frames: Path | StoredFolder,
    settings: DetectSettings,
    closeup_rows: list[int],
    reexposed_rows: list[int],
) -> tuple[dict[int, tuple[bytes, tuple[FloatArray, ...]]], list[Reexposed]]:
    """Draw close-ups of some rows and measure some rows again, if their frames exist."""
    closeups = {}
    reexposed: list[Reexposed] = []
    targets = {target.name: target for target in flight.all_targets}
    for row in dict.fromkeys([*closeup_rows, *reexposed_rows]):
        sighting = numbers.compared[row].attempt.sighting
        if sighting is None:
            continue
        try:
            with at_hand(frames, sighting.frame) as path:
                grey = read_grey(path, flight.camera)
        except (Rejection, KgcpError):
            continue  # the page names the frames without a close-up
        target, radius = targets[sighting.target], float(numbers.data.radius_px[row])
        if row in closeup_rows and sighting.pose is not None:
            view = _ring_view(flight.camera, target, sighting.pose, sighting.centre_px)
            closeups[row] = draw_closeup(grey, view)
        if row in reexposed_rows and isinstance(target, Target):
            with defer_interrupts():
                reexposed += measure_again(
                    grey, flight.camera, target, settings, sighting.centre_px, radius, row
                )
    return closeups, reexposed


def _ring_view(camera: Camera, target: AnyTarget, pose: Pose, centre_px: FloatArray) -> RingView:
    """Return what to draw of a target: its circles and its centre, projected with its pose."""
    diameters_m = target.diameters_m
    circles = [contour_px(camera, pose, 0.5 * diameter_m) for diameter_m in diameters_m]
    radius_px = 0.5 * float(np.ptp(circles[0], axis=0).max())
    centre = camera.project(pose.transform(np.zeros((1, 3))))
    return RingView(centre_px, radius_px, (*circles, centre))
