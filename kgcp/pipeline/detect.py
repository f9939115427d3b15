"""Detection in all frames of a flight: the use case behind `kgcp detect`.

Many processes examine the frames, and the results form one ordered table. An interrupted run is
resumed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from kgcp.errors import KgcpError, SettingError
from kgcp.io.files.atomic import remove
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, require_flight
from kgcp.io.formats.marks import HandMark, read_marks
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.images.remote import StoredFolder, frames_below
from kgcp.io.tables.columns import Row
from kgcp.io.tables.detections import DETECTION_COLUMNS, detection_rows
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.provenance import (
    detections_provenance,
    frame_samples,
    versions,
    write_run_record,
)
from kgcp.io.tables.staleness import refuse_to_replace_whole
from kgcp.measurement.frame import examine
from kgcp.measurement.guided import Prediction
from kgcp.measurement.records import FrameResult
from kgcp.network.ground.exchanged_marks import exchanged_marks
from kgcp.pipeline.detection_run import (
    DetectionRun,
    ProgressListener,
    refuse_to_lose_results,
)
from kgcp.pipeline.execution.compiled_code import compilation
from kgcp.pipeline.execution.executor import WorkerPool, open_pool
from kgcp.pipeline.execution.journal import Journal, fingerprint, to_text
from kgcp.pipeline.execution.kept_frames import KeptFrames, kept_frames, remove_kept_frames
from kgcp.pipeline.execution.profiling import OTHER
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.frame_priors import Priors, priors_of_frames
from kgcp.pipeline.frame_task import DetectionJob, FrameInput, examine_frame
from kgcp.pipeline.guidance import (
    ContradictedMarks,
    marks_against_reference,
    plain_by_results,
    predict_missing,
    searches_by_reference,
    static_by_reference,
    with_predictions,
)
from kgcp.pipeline.overlay import draw_overlay
from kgcp.pipeline.run_summary import DetectionSummary, Stopwatch, SummaryBuilder
from kgcp.pipeline.workspace import DETECTIONS, require_outside_frames, results_folder
from kgcp.quality.checks.plate import check_print
from kgcp.quality.checks.static_targets import check_searches
from kgcp.quality.number_text import counted
from kgcp.report.contact_sheet import ContactSheet
from kgcp.settings import DetectSettings, require_flag, require_kind, require_range
from kgcp.targets.plain import shape_of


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of a run. Only `frame_patterns` and `places` affect the table.

    Attributes
    ----------
    jobs : int or None
        Number of worker processes; 0: this process, without a time limit; None: the number of
        cores, or of the scheduler's threads.
    frame_timeout_s : float
        Time limit for one look at one frame [s].
    is_restart : bool
        Whether to start over instead of resuming an interrupted run.
    is_profiled : bool
        Whether to measure the time of the workers' stages, which slows them down a little.
    scheduler : str or None
        A Dask cluster that does the work: the scheduler's address, or `local:N`. Its workers must
        see the frames under the same path as this machine.
    overlay : Path or None
        Folder of a contact sheet of all rings, which is made after the table.
    all_candidates : bool
        Whether the contact sheet also shows rings that were compared with a target's and dropped.
    stored_frames : StoredFolder or None
        Place of the frames, if they are not in the flight's folder.
    frame_patterns : tuple of str
        Patterns of the wanted frames, see `matching_frames`; empty: all. The table has only these
        frames, and states the patterns.
    places : Path or None
        File of static targets that were marked by hand, see `read_marks`. In frames without a pose,
        plain targets are searched for there.
    """

    jobs: int | None = None
    frame_timeout_s: float = 300.0  # hundreds of times what a large frame takes
    is_restart: bool = False
    is_profiled: bool = False
    scheduler: str | None = None
    overlay: Path | None = None
    all_candidates: bool = False
    stored_frames: StoredFolder | None = None
    frame_patterns: tuple[str, ...] = ()
    places: Path | None = None

    def __post_init__(self) -> None:
        if self.jobs is not None:
            require_range("jobs", self.jobs, 0, 256)
            if self.jobs != int(self.jobs):
                raise SettingError("jobs", f"{self.jobs:g} is not a whole number", "give one")
            object.__setattr__(self, "jobs", int(self.jobs))
        require_range(
            "frame_timeout_s", self.frame_timeout_s, 0.0, math.inf, unit="s", open_low=True
        )
        for key in ("is_restart", "is_profiled", "all_candidates"):
            require_flag(key, getattr(self, key))


class NoProgress:
    """A listener that ignores everything."""

    def note(self, text: str) -> None:
        """Do nothing."""

    def progress(self, stage: str, done: int, total: int, found: int) -> None:
        """Do nothing."""


RUN_RECORD = "run.json"
"""File name of the run's record, which appears last."""

_DEFAULT_SETTINGS = DetectSettings()
_DEFAULT_OPTIONS = RunOptions()
_NEGATIVE = (
    "black and white are swapped in the frames or on the plate; give frames that are not negatives,"
    " or print the ring black on white"
)
_MAX_LOOKS = 4  # looks for plain targets; each uses the results of the one before
_STAGE_CALLERS = (examine_frame, examine)  # the functions that their modules call are the stages


@single_threaded()
def detect_flight(
    flight: Flight,
    settings: DetectSettings = _DEFAULT_SETTINGS,
    *,
    out: Path | str | None = None,
    options: RunOptions = _DEFAULT_OPTIONS,
    listener: ProgressListener | None = None,
) -> DetectionSummary:
    """Examine every frame of a flight and write `detections.parquet`, and `run.json` beside it.

    Where a target was not found, it is searched for again at the place that the other frames
    predict. Results are kept in a journal, so that the same call resumes an interrupted run.

    Parameters
    ----------
    out : Path, optional
        Folder of the results; by default `kgcp` in the flight's folder.
    listener : ProgressListener, optional
        Receives notes and the progress.

    Returns
    -------
    DetectionSummary
        Counts; its `table` is the file of the detections, for `read_detections`.

    Raises
    ------
    KgcpError
        If there are no frames, a pattern matches none, a table of some frames would replace one of
        all, or an interrupted run's results of other frames would be lost, the file of times or of
        reference poses is invalid, `out` cannot be written or is in use by another process, the
        scheduler cannot be used, or frames change or disappear.
    """
    require_flight(flight)
    require_kind("settings", settings, DetectSettings)
    require_kind("options", options, RunOptions)
    stopwatch = Stopwatch()
    out = results_folder(flight.folder) if out is None else Path(out)
    if options.scheduler is not None:
        # workers may run in another folder
        flight = replace(flight, frames_folder=flight.frames_folder.absolute())
    with stopwatch.stage("preparation"):
        task = _prepared_task(flight, settings, options)
        path, is_new = out / ".detections.journal", options.is_restart
        if options.frame_patterns:
            refuse_to_replace_whole(out / DETECTIONS)
            if not is_new:
                chosen = {frame_input.frame for frame_input in task.inputs}
                refuse_to_lose_results(path, [*set(task.all_frames).difference(chosen)])
    job = _job_of(task)
    with Journal(path, _dependencies(job), (FrameResult,), is_new=is_new) as journal:
        with (
            _kept_frames(out, settings, options) as kept,
            open_pool(
                options.jobs,
                options.frame_timeout_s,
                options.scheduler,
                job.frames_folder,
                _STAGE_CALLERS if options.is_profiled else (),
                compilation(),
            ) as pool,
        ):
            job = replace(job, kept_frames=kept)
            run = DetectionRun(job, task.inputs, journal, pool, listener or NoProgress())
            pool.import_meanwhile("pandas")  # pyarrow loads it to write a table
            with stopwatch.stage("first look"):
                run.first_pass()
            with stopwatch.stage("second look"):
                predictions, guide_problem = _measure_missing_targets(run, task)
            with stopwatch.stage("learning"):
                run.learn()
            likely_cause = _likely_cause(run, stopwatch)
            run.require_unchanged_frames()
            if task.sheet is not None:
                task.sheet.clear()
            remove(out / RUN_RECORD)  # else an earlier run's would seem to be the new table's
            with stopwatch.stage("table"):
                builder = _write_detections(out / DETECTIONS, run, task, predictions)
            not_drawn = 0
            if task.sheet is not None:
                with stopwatch.stage("overlay"):
                    not_drawn = draw_overlay(task.sheet, flight.name, run, job, predictions)
        summary = builder.summary(
            table=out / DETECTIONS,
            likely_cause=likely_cause,
            frames_not_chosen=len(task.all_frames) - len(task.inputs),
            kept=run.kept,
            frames_without_attitude=_frames_without_attitude(task),
            not_drawn=not_drawn,
            guide_problem=guide_problem,
            learnt=run.learnt,
            stages_s=_stages_s(stopwatch, journal, pool),
            doubts=[
                *check_print(builder.prints, flight.all_targets, flight.camera),
                *check_searches(builder.searches),
            ],
        )
        record = {**summary.numbers(), "jobs": pool.jobs, "settings": asdict(settings)}
        # after all workers have ended, because the record has their peak memory
        write_run_record(out / RUN_RECORD, record)
        journal.remove()
    return summary


@dataclass(frozen=True, slots=True, eq=False)
class _DetectionTask:
    """A flight with settings and options, before any frame is read."""

    flight: Flight
    settings: DetectSettings
    options: RunOptions
    data: FlightData
    all_frames: Sequence[str]
    inputs: Sequence[FrameInput]  # the wanted frames
    marks: Mapping[str, Sequence[HandMark]]  # of static targets, by frame
    sheet: ContactSheet | None


def _prepared_task(flight: Flight, settings: DetectSettings, options: RunOptions) -> _DetectionTask:
    all_frames = frames_below(options.stored_frames or flight.frames_folder)
    frames = matching_frames(all_frames, options.frame_patterns)
    data = FlightData(flight, all_frames)
    # the frames around tell how a chosen one turned while it was read, chosen or not
    priors = dict(zip(all_frames, priors_of_frames(flight, data, all_frames), strict=True))
    return _DetectionTask(
        flight=flight,
        settings=settings,
        options=options,
        data=data,
        all_frames=all_frames,
        inputs=_frame_inputs(flight, data, {frame: priors[frame] for frame in frames}),
        marks=_marks(flight, data, priors, options.places),
        sheet=None if options.overlay is None else _sheet(flight, options.overlay),
    )


def _job_of(task: _DetectionTask) -> DetectionJob:
    flight, options = task.flight, task.options
    return DetectionJob(
        options.stored_frames or flight.frames_folder,
        flight.camera,
        flight.calibration_covariance,
        flight.targets,
        task.settings,
        keeps_dropped=options.overlay is not None and options.all_candidates,
        plain_targets=flight.plain_targets,
    )


def _kept_frames(
    out: Path, settings: DetectSettings, options: RunOptions
) -> AbstractContextManager[KeptFrames | None]:
    """Return the store of decoded frames; None for a single look, or if other machines work."""
    folder = out / ".detections.frames"
    is_one_look = not settings.is_guided and options.places is None
    if is_one_look or options.scheduler is not None:
        remove_kept_frames(folder)
        return nullcontext()
    return kept_frames(folder)


def _frame_inputs(
    flight: Flight, data: FlightData, priors: Mapping[str, Priors]
) -> list[FrameInput]:
    """Return frames with prior knowledge of each."""
    times = data.frame_times.time_s
    references = static_by_reference(flight, data, [*priors], [*priors.values()])
    return [
        FrameInput(
            frame,
            times.get(frame),
            of_frame,
            flight.may_use_exif_times,
            by_reference.plain,
            by_reference.coded,
        )
        for (frame, of_frame), by_reference in zip(priors.items(), references, strict=True)
    ]


def _measure_missing_targets(
    run: DetectionRun, task: _DetectionTask
) -> tuple[Mapping[int, Mapping[str, Prediction]], str | None]:
    """Search for missing targets where the first look or marks predict them.

    Returns
    -------
    predictions : mapping of mappings
        Predictions of coded targets, by row and name.
    problem : str or None
        Error in the data from which they are predicted.
    """
    predictions: Mapping[int, Mapping[str, Prediction]] = {}
    problem = None
    is_guided = task.settings.is_guided
    if is_guided:
        predictions, problem = predict_missing(task.flight, task.data, run.tracks)
    run.guided_pass(predictions, {})
    if is_guided or task.marks:
        _look_for_plain(run, task, _MAX_LOOKS if is_guided else 1)
    return predictions, problem


def _look_for_plain(run: DetectionRun, task: _DetectionTask, looks: int) -> None:
    """Search for plain targets where the results predict them, until there are no new predictions.

    A target that is found predicts others in its frame and in neighbouring frames. If a prediction
    is too uncertain, the first look states this in the row; a later look may be certain.
    """
    tried: set[tuple[int, str]] = set()
    for look in range(looks):
        plain = plain_by_results(
            task.flight,
            task.data,
            run.results(),
            run.tracks.time_s,
            task.marks,
            [each.priors for each in task.inputs],
            tried,
        )
        sure = {
            row: {name: each for name, each in predictions.items() if each.is_sure}
            for row, predictions in plain.items()
        }
        sure = {row: predictions for row, predictions in sure.items() if predictions}
        run.guided_pass({}, sure if look else plain)
        if not sure:
            return
        tried |= {(row, name) for row, predictions in sure.items() for name in predictions}


def _likely_cause(run: DetectionRun, stopwatch: Stopwatch) -> str | None:
    """Return why no target was found in any frame, if a trial with negatives shows it."""
    if not run.tracks.is_readable.any() or run.tracks.found:
        return None
    with stopwatch.stage("trial of negatives"):
        return _NEGATIVE if run.is_negative() else None


def _marks(
    flight: Flight, data: FlightData, priors: Mapping[str, Priors], places: Path | None
) -> Mapping[str, Sequence[HandMark]]:
    if places is None:
        return {}
    if not flight.plain_targets or flight.crs is None:
        lacks = "crs" if flight.plain_targets else "target without a code, which marks are for"
        raise KgcpError(
            f"{flight.folder / 'flight.toml'}: has no {lacks}; give one, or leave out the marked"
            " places",
            option="places",
        )
    static = {target.name for target in flight.static_targets}
    marks = read_marks(places, set(priors), static, flight.camera)
    for frame, in_frame in marks.items():
        by_target = {mark.target: mark.place for mark in in_frame}
        names = exchanged_marks(by_target, data.static_positions.static, flight.camera)
        if names is not None:
            *others, last = map(repr, names)
            raise KgcpError(
                f"{places}: the marks of {', '.join(others)} and {last} in {frame} seem to be"
                " exchanged; exchange their names, or look at their position_m",
                option="places",
            )
    wrong = marks_against_reference(flight, data, marks, priors)
    if wrong is not None:
        raise KgcpError(f"{places}: {_contradiction(wrong)}", option="places")
    return marks


def _contradiction(wrong: ContradictedMarks) -> str:
    """Return in words how marks contradict reference poses, and what to do."""
    poses = (
        "give rough [reference] poses their standard deviations (sd_x, sd_y, sd_z, sd_angle_deg),"
        " or do without them"
    )
    mark = "correct the marks, or the targets' position_m"
    is_most = 2 * wrong.contradicted > wrong.compared
    remedy = f"{poses}; else {mark}" if is_most else f"{mark}; else {poses}"
    off = f"is off by {wrong.off_px:.0f} px"
    if math.isinf(wrong.off_px):
        off = "should be out of sight"
    return (
        f"{wrong.contradicted} of {counted(wrong.compared, 'mark')} are not where the reference"
        f" poses have the targets: {wrong.target!r} in {wrong.frame} {off}; {remedy}"
    )


def _sheet(flight: Flight, folder: Path) -> ContactSheet:
    require_outside_frames(flight, folder, "sheet", option="overlay")
    return ContactSheet(folder)


def _stages_s(
    stopwatch: Stopwatch, journal: Journal[FrameResult], pool: WorkerPool
) -> dict[str, float]:
    """Return times by stage: those of this process, then those of all workers together."""
    stages_s = dict(stopwatch.stages_s)
    stages_s[OTHER] = stopwatch.seconds - sum(stages_s.values())
    stages_s["journal, within these"] = journal.seconds
    if pool.callers:
        workers = pool.stages_s.most_common()
        stages_s |= {f"workers: {stage}": seconds for stage, seconds in workers}
        open_s = stopwatch.seconds - stages_s["preparation"]
        idle_s = max(1, pool.jobs) * open_s - pool.stages_s.total()
        stages_s["workers: starting, waiting, ending"] = idle_s
    return stages_s


def _dependencies(job: DetectionJob) -> dict[str, str]:
    """Return what the results of all frames depend on, so that a change can be named."""
    return {
        **{f"the version of {name}": value for name, value in versions().items()},
        **{name: to_text(value) for name, value in asdict(job.settings).items()},
        "the camera": fingerprint(job.camera, job.calibration_covariance),
        "the targets": fingerprint(job.all_targets),
        "all_candidates": to_text(job.keeps_dropped),
    }


def _frames_without_attitude(task: _DetectionTask) -> int:
    """Return the number of frames without an attitude that would decide a level plate's pose."""
    vehicle = task.flight.vehicle
    if vehicle is None or vehicle.settings.level_sd_deg is None:
        return 0
    return sum(
        all(prior.normal is None for prior in frame_input.priors.values())
        for frame_input in task.inputs
    )


def _write_detections(
    table: Path,
    run: DetectionRun,
    task: _DetectionTask,
    predictions: Mapping[int, Mapping[str, Prediction]],
) -> SummaryBuilder:
    """Write the table; return the counts of its rows."""
    left_out = set(task.all_frames).difference(each.frame for each in task.inputs)
    times = task.data.frame_times.time_s
    builder = SummaryBuilder({name: times[name] for name in times if name not in left_out})
    about = detections_provenance(
        task.flight,
        task.settings,
        run.frame_sizes,
        frame_samples(task.options.stored_frames or task.flight.frames_folder, run.frame_sizes),
        task.data.frame_times,
        run.learnt,
        task.options.frame_patterns,
        task.options.places,
    )
    rows = _rows(run, predictions, task, builder)
    write_table(table, DETECTION_COLUMNS, rows, about)
    return builder


def _rows(
    run: DetectionRun,
    predictions: Mapping[int, Mapping[str, Prediction]],
    task: _DetectionTask,
    builder: SummaryBuilder,
) -> Iterator[Row]:
    flight = task.flight
    shapes = {target.name: shape_of(target) for target in flight.all_targets}
    for row, result in enumerate(run.results()):
        completed = with_predictions(result, predictions.get(row, {}), flight.camera)
        plain = task.inputs[row].plain
        builder.add(completed, searches_by_reference(completed, plain, flight.camera))
        yield from detection_rows(completed, shapes)
