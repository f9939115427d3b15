"""Prediction of a flight's targets in frames in which they were not found."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kgcp.errors import KgcpError, Reason
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.plain_neighbours import PlainTracks
from kgcp.georef.plain_prediction import (
    FrameOrientation,
    Predictions,
    Rotations,
    predict_marked,
    predict_places,
    predict_plain,
    reference_orientations,
)
from kgcp.georef.prediction import Track, predict_position, reference_states, state_of
from kgcp.georef.sighting import Sighting, sighting_of
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.formats.marks import HandMark
from kgcp.measurement.guided import Prediction
from kgcp.measurement.plain_prediction import PredictedPlace
from kgcp.measurement.records import FrameResult, Measurement, Miss, is_unreadable
from kgcp.network.ground.frame_motions import motions_by_rates
from kgcp.network.ground.frame_poses import orient_frames, print_scale_sd
from kgcp.pipeline.frame_priors import Priors
from kgcp.quality.checks.static_targets import PlainSearch
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget

# Reasons for which rings that do not belong to the target may be dropped.
_NO_TARGET = {
    *(Reason.NO_CANDIDATE, Reason.CODE_MISMATCH, Reason.OTHER_CODE, Reason.TOO_SMALL),
    *(Reason.TOO_BLURRED, Reason.CLIPPED, Reason.HIDDEN, Reason.CUT),
}

# How many standard deviations a mark may be off the place by the reference pose. One in a thousand
# marks is off by four, and a single wrong one stops a run.
_MARK_SIGMAS = 6.0


class FrameTracks:
    """The few numbers of every frame that predictions for other frames need."""

    def __init__(self, targets: Sequence[AnyTarget], frames: Sequence[str]) -> None:
        self.frames = frames
        self.time_s = np.full(len(frames), math.nan)  # mid-exposures [s]; NaN: not known
        # (n, 3) by the target's name, as in `Track`
        self.states = {target.name: np.full((len(frames), 3), math.nan) for target in targets}
        self.is_readable = np.zeros(len(frames), dtype=np.bool_)  # whether there is an image
        self.found = 0  # number of frames in which any target was measured
        self._is_found = np.zeros(len(frames), dtype=np.bool_)

    def add(self, row: int, result: FrameResult) -> None:
        """Add the result of a frame, or replace its former result."""
        self.time_s[row] = math.nan if result.time_s is None else result.time_s
        self.is_readable[row] = not any(map(is_unreadable, result.outcomes))
        measured = [each for each in result.outcomes if isinstance(each, Measurement)]
        self.found += bool(measured) - int(self._is_found[row])
        self._is_found[row] = bool(measured)
        for observation in measured:
            if observation.instance == 0:
                self.states[observation.target][row] = state_of(observation)


def predict_missing(
    flight: Flight, data: FlightData, tracks: FrameTracks
) -> tuple[dict[int, dict[str, Prediction]], str | None]:
    """Return predictions of missing coded targets, as far as they are certain enough.

    Returns
    -------
    predictions : dict of dict
        By the frame's row and the target's name; rows without predictions are left out.
    problem : str or None
        Error in reference poses or trajectory. It is not raised, because detection needs neither.
    """
    predictions: dict[int, dict[str, Prediction]] = {}
    problem = None
    for target in flight.targets:
        track = Track(tracks.time_s, tracks.states[target.name])
        if not 0 < track.is_found.sum() < len(tracks.frames):
            continue
        states = None
        try:
            if data.has_reference and data.has_position_of(target):
                states = reference_states(
                    tracks.frames,
                    [None if math.isnan(time_s) else float(time_s) for time_s in tracks.time_s],
                    target,
                    data.reference_poses,
                    data.target_positions,
                    flight.camera,
                )
        except KgcpError as error:
            problem = str(error)
        for row, prediction in enumerate(predict_position(track, states)):
            if prediction is not None and prediction.is_sure:
                predictions.setdefault(row, {})[target.name] = prediction
    return predictions, problem


@dataclass(frozen=True, slots=True, eq=False)
class ByReference:
    """What the reference pose of a frame predicts of static targets, by their names."""

    plain: Predictions = field(default_factory=dict)  # of plain targets
    # of coded targets whose positions have standard deviations
    coded: Mapping[str, PredictedPlace] = field(default_factory=dict)


def static_by_reference(
    flight: Flight, data: FlightData, frames: Sequence[str], priors: Sequence[Priors]
) -> list[ByReference]:
    """Return for each frame what its reference pose predicts, if there are plain targets.

    Parameters
    ----------
    priors : sequence of mapping
        Of each frame.

    Raises
    ------
    KgcpError
        If there are plain targets, and the reference poses cannot be read or there is no crs.
    """
    if not flight.plain_targets or not data.has_reference:
        return [ByReference()] * len(frames)
    positions, camera = data.static_positions, flight.camera
    orientations = reference_orientations(data.reference_poses, positions.local_frame)
    coded = [
        target
        for target in flight.static_targets
        if isinstance(target, Target) and positions.static[target.name].cov_m2 is not None
    ]
    return [
        ByReference(
            predict_plain(flight.plain_targets, orientations[frame], positions, camera, rotations),
            predict_places(coded, orientations[frame], positions, camera, rotations),
        )
        if frame in orientations
        else ByReference()
        for frame, rotations in zip(frames, map(_rotations, priors), strict=True)
    ]


def _rotations(priors: Priors) -> Rotations:
    """Return how the scene turns about a frame's targets while it is read, where it is known."""
    return {name: prior.rotation for name, prior in priors.items() if prior.rotation is not None}


def searches_by_reference(
    result: FrameResult, predicted: Predictions, camera: Camera
) -> Iterator[PlainSearch]:
    """Yield how plain targets were found where a frame's reference pose has them.

    Left out are those that are not wholly inside the frame, those with too uncertain a prediction,
    and those that another source predicted, since the pose contradicts coded targets.
    """
    for outcome in result.outcomes:
        prediction = predicted.get(outcome.target)
        if prediction is None or not prediction.is_sure or not prediction.is_inside(camera):
            continue
        if isinstance(outcome, Miss):
            if not is_unreadable(outcome) and outcome.reason is not Reason.NO_PREDICTION:
                yield PlainSearch(result.frame, outcome.target, None)
        elif not outcome.is_guided:
            off_px = outcome.centre_px - prediction.centre_px
            chi2 = float(off_px @ np.linalg.solve(prediction.cov_px2, off_px))
            yield PlainSearch(result.frame, outcome.target, chi2)


@dataclass(frozen=True, slots=True)
class ContradictedMarks:
    """Marks by hand that are not where reference poses predict the targets."""

    frame: str  # of the farthest one
    target: str
    off_px: float  # how far it is off
    contradicted: int
    compared: int


def marks_against_reference(
    flight: Flight,
    data: FlightData,
    marks: Mapping[str, Sequence[HandMark]],
    priors: Mapping[str, Priors],
) -> ContradictedMarks | None:
    """Compare marks with the reference poses of their frames; None: none is contradicted.

    A mark on the predicted target is not contradicted, even if it is not at its centre.

    Parameters
    ----------
    priors : mapping of mappings
        By frame, for all frames with marks.
    """
    if not data.has_reference:
        return None
    positions, static = data.static_positions, flight.static_targets
    orientations = reference_orientations(data.reference_poses, positions.local_frame)
    compared, contradicted = 0, []
    for frame in marks.keys() & orientations.keys():
        rotations = _rotations(priors[frame])
        places = predict_places(static, orientations[frame], positions, flight.camera, rotations)
        for mark in marks[frame]:
            predicted = places[mark.target]
            compared += 1
            place_px = np.array([mark.place.x_px, mark.place.y_px])
            off_px = predicted.contradiction_px(place_px, mark.place.sd_px, _MARK_SIGMAS)
            if off_px is not None and off_px > predicted.radius_px:
                contradicted.append((off_px, frame, mark.target))
    if not contradicted:
        return None
    off_px, frame, target = max(contradicted)
    return ContradictedMarks(frame, target, off_px, len(contradicted), compared)


def plain_by_results(
    flight: Flight,
    data: FlightData,
    results: Iterable[FrameResult],
    time_s: FloatArray,
    marks: Mapping[str, Sequence[HandMark]],
    priors: Sequence[Priors],
    tried: Collection[tuple[int, str]] = (),
) -> dict[int, Predictions]:
    """Return by row predictions of plain targets that have had no certain prediction so far.

    There are three sources, the best first: the pose of the frame by its other static targets,
    marks by hand, and the frames before and after.

    Parameters
    ----------
    results : iterable of FrameResult
        Results of all n frames so far, in the frames' order.
    time_s : (n,) array
        Mid-exposures [s]; NaN: unknown.
    marks : mapping
        Static targets that were marked by hand, by frame.
    priors : sequence of mapping
        Of each frame.
    tried : collection of tuple
        Rows and targets that were already searched for with a certain prediction.
    """
    if not flight.plain_targets or flight.crs is None:
        return {}
    static = {target.name for target in flight.static_targets}
    tracks = PlainTracks(flight.plain_targets, time_s)
    rows: dict[str, int] = {}
    lacking: dict[int, set[str]] = {}
    sightings: list[Sighting] = []
    for row, result in enumerate(results):
        tracks.add(row, result)
        misses = [outcome for outcome in result.outcomes if isinstance(outcome, Miss)]
        names = {miss.target for miss in misses if miss.reason is Reason.NO_PREDICTION}
        names = {name for name in names if (row, name) not in tried}
        if names:
            rows[result.frame], lacking[row] = row, names
            sightings += [
                sighting_of(result.frame, row + 1, result.time_s, outcome)
                for outcome in result.outcomes
                if isinstance(outcome, Measurement) and outcome.target in static
            ]
    if not lacking:
        return {}
    by_neighbours = tracks.predictions(flight.camera, lacking)
    by_targets = _by_other_targets(
        flight, data, {frame: _rotations(priors[row]) for frame, row in rows.items()}, sightings
    )
    predictions: dict[int, Predictions] = {}
    for frame, row in rows.items():
        places = {mark.target: mark.place for mark in marks.get(frame, ())}
        by_marks = predict_marked(
            flight.plain_targets, places, data.static_positions, flight.camera
        )
        # later entries win: certain predictions, and then better sources
        sources = (by_neighbours.get(row, {}), by_marks, by_targets.get(frame, {}))
        best = {
            name: each
            for is_sure in (False, True)
            for source in sources
            for name, each in source.items()
            if name in lacking[row] and each.is_sure is is_sure
        }
        if best:
            predictions[row] = best
    return predictions


def _by_other_targets(
    flight: Flight,
    data: FlightData,
    rotations: Mapping[str, Rotations],
    sightings: Sequence[Sighting],
) -> dict[str, Predictions]:
    """Return by frame the predictions of plain targets by the pose from other static targets.

    `rotations` are those of the frames to predict for.
    """
    predictions: dict[str, Predictions] = {}
    positions = data.static_positions
    for oriented in orient_frames(
        [*rotations],
        sightings,
        positions.static,
        flight.camera,
        sd_scale=print_scale_sd(flight.static_targets),
        motions=motions_by_rates(data.scene_rotations),
    ):
        if oriented.pose is not None:
            orientation = FrameOrientation(
                oriented.pose.centre_m,
                oriented.pose.world_from_camera,
                oriented.cov,
                "the frame's other targets",
            )
            predictions[oriented.frame] = predict_plain(
                flight.plain_targets,
                orientation,
                positions,
                flight.camera,
                rotations[oriented.frame],
            )
    return predictions


def with_predictions(
    result: FrameResult, predictions: Mapping[str, Prediction], camera: Camera
) -> FrameResult:
    """Add predictions to misses; if the target is outside the frame, this becomes the reason.

    A ring in the frame is then something else. But a ring that had the right code and failed a
    later test contradicts the prediction, and keeps its reason.
    """
    outcomes = tuple(
        _with_prediction(outcome, predictions[outcome.target], camera)
        if isinstance(outcome, Miss)
        and outcome.target in predictions
        and not is_unreadable(outcome)
        else outcome
        for outcome in result.outcomes
    )
    return replace(result, outcomes=outcomes)


def is_out_of_view(reason: Reason, prediction: Prediction, camera: Camera) -> bool:
    """Tell whether a target is outside the frame, so that rings in it are something else.

    Parameters
    ----------
    reason : Reason
        Reason of the miss without the prediction.
    """
    return prediction.is_outside(camera) and reason in _NO_TARGET


def _with_prediction(miss: Miss, prediction: Prediction, camera: Camera) -> Miss:
    if is_out_of_view(miss.reason, prediction, camera):
        detail = f"{prediction}, outside the frame"
        return replace(miss, reason=Reason.OUT_OF_VIEW, detail=detail, outline=None)
    return replace(miss, detail="; ".join(filter(None, (miss.detail, str(prediction)))))
