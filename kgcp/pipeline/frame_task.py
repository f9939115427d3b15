"""Tasks for one frame: first and second look, and the results if they end their process."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera, TimeReference
from kgcp.geometry.circle_image import Circles3D, eccentricity
from kgcp.geometry.conic import Ellipse
from kgcp.io.images.exif import Exif, read_exif
from kgcp.io.images.frames import read_grey
from kgcp.io.images.remote import StoredFolder, at_hand
from kgcp.measurement.frame import examine, miss_of
from kgcp.measurement.guided import Prediction, measure_guided
from kgcp.measurement.plain_checks import refuse_shared_edges
from kgcp.measurement.plain_prediction import PlainPrediction, PredictedPlace
from kgcp.measurement.plain_target import measure_plain
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import (
    Considered,
    ExposureSettings,
    FrameResult,
    Measurement,
    Miss,
    Outcome,
    TimeSource,
    ToneBase,
    is_unreadable,
)
from kgcp.measurement.search.template_match import MIN_SCORE_OF_A_CODE
from kgcp.measurement.systematic_errors import common_uncertainty
from kgcp.pipeline.execution.kept_frames import KeptFrames
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget, PlainTarget

_LEAST_CONTRADICTIONS = 2  # coded targets that contradict a pose; one alone may have been moved
_MAX_DROPPED = 24  # dropped rings per frame that are kept to be shown; textures may have hundreds


@dataclass(frozen=True, slots=True)
class DetectionJob:
    """Everything that a worker needs to examine any frame of a flight."""

    frames_folder: Path | StoredFolder
    camera: Camera
    calibration_covariance: CalibrationCovariance | None
    targets: tuple[Target, ...]
    settings: DetectSettings
    # whether the results include rings that were compared with a target's and dropped
    keeps_dropped: bool = False
    plain_targets: tuple[PlainTarget, ...] = ()
    # decoded frames kept for a second look; None: they are decoded again
    kept_frames: KeptFrames | None = None
    # known curve to which an unknown tone curve is a correction; None: not decided yet
    tone_base: ToneBase | None = None

    @property
    def all_targets(self) -> tuple[AnyTarget, ...]:
        """Coded targets, then plain ones: the order of a frame's outcomes."""
        return (*self.targets, *self.plain_targets)

    def target_of(self, measurement: Measurement) -> AnyTarget:
        """Return the target that was measured."""
        return next(target for target in self.all_targets if target.name == measurement.target)

    def priors(self, frame_input: FrameInput) -> Mapping[str, PlatePrior]:
        """Return the priors of a frame's targets, by their names."""
        priors = frame_input.priors
        if self.tone_base is None:
            return priors
        return {
            target.name: replace(priors.get(target.name, PlatePrior()), tone_base=self.tone_base)
            for target in self.targets
        }


@dataclass(frozen=True, slots=True)
class FrameInput:
    """Everything that a worker needs to know about one frame."""

    frame: str  # path relative to the frames folder
    # time in the times file, at the camera's `time_reference`, Unix UTC [s]; None: it has none
    time_s: float | None
    priors: Mapping[str, PlatePrior]  # of its targets, by their names
    may_use_exif_time: bool = True  # whether EXIF gives the time if the times file does not
    # predictions of plain targets, by their names
    plain: Mapping[str, PlainPrediction] = field(default_factory=dict)
    # places of coded static targets by the same source, which check it
    coded: Mapping[str, PredictedPlace] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class GuidedInput:
    """A frame for a second look."""

    input: FrameInput
    first: FrameResult  # of the first look
    # predictions of missing coded targets, which must be visible, by their names
    predictions: Mapping[str, Prediction]
    # predictions of plain targets from the targets of the first look, by their names
    plain: Mapping[str, PlainPrediction] = field(default_factory=dict)


@single_threaded()
def examine_frame(job: DetectionJob, frame_input: FrameInput) -> FrameResult:
    """Read and measure one frame; errors of the frame become its result."""
    exif = Exif()
    outcomes: tuple[Outcome, ...]
    dropped: tuple[Considered, ...] = ()
    try:
        with at_hand(job.frames_folder, frame_input.frame) as path:
            exif = read_exif(path)
            grey = read_grey(path, job.camera)
        examination = examine(grey, job.camera, job.targets, job.settings, job.priors(frame_input))
        measured = [each for each in examination.outcomes if isinstance(each, Measurement)]
        plain = _first_plain(job, frame_input, grey, measured)
        outcomes = completed(job, (*examination.outcomes, *refuse_shared_edges(plain)))
        if job.kept_frames is not None and any(isinstance(outcome, Miss) for outcome in outcomes):
            job.kept_frames.keep(frame_input.frame, grey)
        if job.keeps_dropped:
            dropped = _best_dropped(examination.considered)
    except Rejection as rejection:
        outcomes = tuple(
            Miss(target.name, rejection.reason, rejection.detail) for target in job.all_targets
        )
    is_readable = not any(map(is_unreadable, outcomes))
    time_s, time_source = _frame_time(job, frame_input, exif, is_readable=is_readable)
    return FrameResult(
        frame_input.frame, time_s, exif.exposure, outcomes, exif.time_s, dropped, time_source
    )


def _first_plain(
    job: DetectionJob, frame_input: FrameInput, grey: GreyArray, measured: Sequence[Measurement]
) -> list[Outcome]:
    """Measure the plain targets where the reference pose predicts them, unless it is wrong.

    It is if most coded static targets, and at least two, are not where it has them. Another target
    may then be where it predicts a plain one. A later look may have a better prediction.
    """
    contradiction = _contradiction(frame_input.coded, measured)
    if contradiction is not None:
        return [
            Miss(target.name, Reason.NO_PREDICTION, contradiction) for target in job.plain_targets
        ]
    return [
        measure_plain(
            grey,
            job.camera,
            target,
            _predicted(frame_input, frame_input.plain, target),
            measured,
        )
        for target in job.plain_targets
    ]


def _contradiction(
    places: Mapping[str, PredictedPlace], measured: Sequence[Measurement]
) -> str | None:
    """Return in words how the reference pose contradicts coded targets; None: it does not."""
    several = {each.target for each in measured if each.instance}
    compared = [
        places[each.target].contradiction_px(each.centre_px)
        for each in measured
        if each.target in places and each.target not in several
    ]
    off_px = [each for each in compared if each is not None]
    if len(off_px) < _LEAST_CONTRADICTIONS or 2 * len(off_px) <= len(compared):
        return None
    worst = "out of sight"
    if math.isfinite(max(off_px)):
        worst = f"{max(off_px):.0f} px off their places"
    return f"the reference pose has coded targets {worst}"


def _frame_time(
    job: DetectionJob, frame_input: FrameInput, exif: Exif, *, is_readable: bool
) -> tuple[float | None, TimeSource]:
    """Return the mid-exposure of a frame [s] and its source."""
    time_s, time_source = frame_input.time_s, TimeSource.TIMES_FILE
    if time_s is None and frame_input.may_use_exif_time:
        time_s, time_source = exif.time_s, TimeSource.EXIF
    reference = job.camera.time_reference
    if time_s is not None and reference is not TimeReference.MIDDLE:
        path = job.frames_folder / frame_input.frame
        time_s = _mid_exposure_s(time_s, exif.exposure, reference, path) if is_readable else None
    return time_s, TimeSource.NONE if time_s is None else time_source


@single_threaded()
def examine_frame_again(job: DetectionJob, guided_input: GuidedInput) -> FrameResult:
    """Search again for missing targets of a frame at their predicted places."""
    grey = _read_again(job, guided_input.input.frame)
    measured = {
        outcome.target: outcome
        for outcome in guided_input.first.outcomes
        if isinstance(outcome, Measurement) and outcome.instance == 0
    }
    priors = job.priors(guided_input.input)
    considered: list[Considered] = []
    for target in job.targets:
        if target.name in guided_input.predictions:
            measurement, compared = measure_guided(
                grey,
                job.camera,
                target,
                guided_input.predictions[target.name],
                job.settings,
                priors.get(target.name, PlatePrior()),
                tuple(measured.values()),
            )
            considered += compared
            if measurement is not None:
                measured[target.name] = measurement
    outcomes = _outcomes_of_second_look(job, guided_input, grey, measured, considered)
    dropped = guided_input.first.dropped
    if job.keeps_dropped:
        dropped = _best_dropped((*dropped, *considered))
    return replace(guided_input.first, outcomes=outcomes, dropped=dropped)


def _read_again(job: DetectionJob, frame: str) -> GreyArray:
    kept = None if job.kept_frames is None else job.kept_frames.find(frame)
    if kept is not None:
        return kept
    try:
        with at_hand(job.frames_folder, frame) as path:
            return read_grey(path, job.camera)
    except Rejection as rejection:
        raise KgcpError(
            f"{job.frames_folder / frame}: was readable before, but is not any more"
            f" ({rejection.detail}); restore it and repeat the command, which resumes"
        ) from rejection


@single_threaded()
def shows_negative(job: DetectionJob, frame_input: FrameInput) -> bool:
    """Tell whether a target is measured in a frame whose black and white are swapped."""
    try:
        with at_hand(job.frames_folder, frame_input.frame) as path:
            grey = read_grey(path, job.camera)
    except Rejection:
        return False
    negative = np.iinfo(grey.dtype).max - grey
    examination = examine(negative, job.camera, job.targets, job.settings, frame_input.priors)
    return any(isinstance(outcome, Measurement) for outcome in examination.outcomes)


def lost_frame(job: DetectionJob, frame_input: FrameInput, reason: Reason) -> FrameResult:
    """Return the result of a frame whose examination ends the process."""
    outcomes = tuple(Miss(target.name, reason) for target in job.all_targets)
    is_middle = job.camera.time_reference is TimeReference.MIDDLE
    time_s = frame_input.time_s if is_middle else None
    time_source = TimeSource.NONE if time_s is None else TimeSource.TIMES_FILE
    return FrameResult(
        frame_input.frame, time_s, ExposureSettings(), outcomes, time_source=time_source
    )


def result_without_second_look(guided_input: GuidedInput, reason: Reason) -> FrameResult:
    """Return the result of the first look for a frame whose second look ended the process."""
    outcomes = tuple(
        replace(outcome, detail="; ".join(filter(None, (outcome.detail, f"second look: {reason}"))))
        if isinstance(outcome, Miss)
        else outcome
        for outcome in guided_input.first.outcomes
    )
    return replace(guided_input.first, outcomes=outcomes)


def _predicted(
    frame_input: FrameInput, plain: Mapping[str, PlainPrediction], target: PlainTarget
) -> PlainPrediction | None:
    """Return the prediction of a plain target, completed by the scene's rotation if known."""
    prediction, prior = plain.get(target.name), frame_input.priors.get(target.name)
    if prediction is None or prior is None:
        return prediction
    return replace(prediction, rotation=prior.rotation)


def _outcomes_of_second_look(
    job: DetectionJob,
    guided_input: GuidedInput,
    grey: GreyArray,
    by_target: Mapping[str, Measurement],
    considered: Sequence[Considered],
) -> tuple[Outcome, ...]:
    """Return the outcomes of coded targets, and of plain ones that are predicted by now."""
    outcomes = _coded_outcomes(job, guided_input, grey, by_target, considered)
    measured = [outcome for outcome in outcomes if isinstance(outcome, Measurement)]
    found: list[Outcome] = []
    for target in job.plain_targets:
        prediction = _predicted(guided_input.input, guided_input.plain, target)
        if prediction is not None:
            outcome = measure_plain(grey, job.camera, target, prediction, measured)
            if isinstance(outcome, Measurement):
                outcome = replace(outcome, is_guided=True)
            found.append(outcome)
    plain = {outcome.target: outcome for outcome in completed(job, refuse_shared_edges(found))}
    return tuple(
        plain.get(outcome.target, outcome)
        if isinstance(outcome, Miss) and outcome.reason is Reason.NO_PREDICTION
        else outcome
        for outcome in outcomes
    )


def _coded_outcomes(
    job: DetectionJob,
    guided_input: GuidedInput,
    grey: GreyArray,
    measured: Mapping[str, Measurement],
    considered: Sequence[Considered],
) -> tuple[Outcome, ...]:
    """Replace misses by new measurements, and update the reasons of the remaining ones.

    Parameters
    ----------
    measured : mapping of str to Measurement
        Measurements of both looks, by target.
    considered : sequence of Considered
        Rings that the second look compared with a target.
    """
    first_outcomes = guided_input.first.outcomes
    misses = {outcome.target: outcome for outcome in first_outcomes if isinstance(outcome, Miss)}
    missing = tuple(target for target in job.targets if target.name not in measured)
    if misses.keys() & measured.keys():  # rings on these plates no longer explain other misses
        plates = tuple(measured.values())
        again = examine(
            grey, job.camera, missing, job.settings, job.priors(guided_input.input), plates
        )
        misses |= {
            outcome.target: outcome for outcome in again.outcomes if isinstance(outcome, Miss)
        }
    replacements: dict[str, Outcome] = {}
    for target in missing:
        code_like = [
            ring
            for ring in considered
            if ring.target == target.name and ring.score >= MIN_SCORE_OF_A_CODE
        ]
        replacements[target.name] = (
            miss_of(grey, target, code_like, job.settings, job.targets)
            if code_like
            else misses[target.name]
        )
    new = [measured[name] for name in misses if name in measured]
    replacements |= {outcome.target: outcome for outcome in completed(job, new)}
    return tuple(
        replacements.get(outcome.target, outcome) if isinstance(outcome, Miss) else outcome
        for outcome in first_outcomes
    )


def _best_dropped(considered: Sequence[Considered]) -> tuple[Considered, ...]:
    """Return the dropped rings that passed most tests, one per outline."""
    dropped = (ring for ring in considered if ring.reason is not None)
    best: dict[Ellipse, Considered] = {}
    for ring in sorted(dropped, key=lambda ring: (not ring.is_match, -ring.score)):
        best.setdefault(ring.outline, ring)
    return tuple(best.values())[:_MAX_DROPPED]


def _mid_exposure_s(
    time_s: float,
    exposure: ExposureSettings,
    reference: TimeReference,
    path: Path | StoredFolder,
) -> float:
    if exposure.exposure_time_s is None:
        raise KgcpError(
            f"{path}: has no exposure time in EXIF, which [camera] time_reference ="
            f" '{reference.value}' in flight.toml needs; write EXIF into the frames, or give times"
            " of mid-exposure and delete time_reference"
        )
    return time_s + reference.to_middle_s(exposure.exposure_time_s)


def completed(job: DetectionJob, outcomes: Sequence[Outcome]) -> tuple[Outcome, ...]:
    """Add to outcomes what follows from their poses: common uncertainty and eccentricity.

    Outcomes of many frames may be passed at once, which takes a tenth of the time per frame.
    """
    measured = [outcome for outcome in outcomes if isinstance(outcome, Measurement)]
    eccentricities_px = iter(_eccentricities_px(job, measured))
    return tuple(
        replace(
            outcome,
            common=common_uncertainty(
                job.camera, job.calibration_covariance, job.target_of(outcome), outcome.pose
            ),
            eccentricity_px=next(eccentricities_px),
        )
        if isinstance(outcome, Measurement)
        else outcome
        for outcome in outcomes
    )


def _eccentricities_px(job: DetectionJob, measured: Sequence[Measurement]) -> FloatArray:
    """Return the offsets (n, 2) of outer circles' centroids from their centres [px]."""
    if not measured:
        return np.empty((0, 2))
    poses = [measurement.pose for measurement in measured]
    diameters_m = [job.target_of(measurement).outer_diameter_m for measurement in measured]
    circles = Circles3D(
        np.array([pose.translation_m for pose in poses]),
        np.array([pose.rotation[:, :2] for pose in poses]),
        0.5 * np.array(diameters_m),
    )
    eccentricities_px = eccentricity(job.camera, circles).total_px
    for i, measurement in enumerate(measured):
        if measurement.image is not None:  # of plain targets, the centroid itself is measured
            eccentricities_px[i] = measurement.image.moments[:2] - measurement.centre_px
    return eccentricities_px
