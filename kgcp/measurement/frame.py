"""All targets of one frame: outlines of rings, codes and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import BoolArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.closed_form.chain import measure_ring
from kgcp.measurement.closed_form.circles import paper_outlines
from kgcp.measurement.diagnosis import explain, ring_to_explain
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import Considered, Measurement, Miss, Outcome
from kgcp.measurement.search.candidates import Candidate, find_code, find_dotted_rings, find_rings
from kgcp.measurement.search.code_signal import CodeMatch, fixed_lag_score, points_of_code
from kgcp.measurement.search.false_alarm import check_false_alarm
from kgcp.measurement.search.initial_pose import initial_pose
from kgcp.measurement.search.template_match import match_templates_at
from kgcp.settings import DetectSettings, Method
from kgcp.targets.layout import Ring, Target

# If at least this share of the main ring's code circle is in the frame, a replica is accepted only
# if the main ring shows the target's code, with this score or with this heading relative to the
# replica
_MIN_VISIBLE = 0.3
_MIN_MAIN_SCORE = 0.75
_MOST_TURNED_DEG = 8.0


@dataclass(frozen=True, slots=True)
class Examination:
    """What one frame says about all targets."""

    # in the order of the targets; for each target either its plates as measurements, instance 0, 1,
    # … in order of score, or one Miss with the reason of its best candidate
    outcomes: tuple[Outcome, ...]
    considered: tuple[Considered, ...]  # all rings that were compared with a target's


@dataclass(frozen=True, slots=True)
class _Trial:
    """The plates measured for one target, before they are compared with those of the others."""

    target: Target
    plates: tuple[Measurement, ...]
    considered: tuple[Considered, ...]


def examine(
    grey: GreyArray,
    camera: Camera,
    targets: tuple[Target, ...],
    settings: DetectSettings,
    priors: Mapping[str, PlatePrior] = MappingProxyType({}),
    measured: Sequence[Measurement] = (),
) -> Examination:
    """Look for every target in a frame and measure what is found.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame, uint8 or uint16, of the camera's size.
    targets : tuple of Target
        All targets that may be seen.
    priors : mapping of str to PlatePrior, optional
        What is known of targets beforehand, by their names.
    measured : sequence of Measurement
        Targets of this frame that are already measured.
    """
    if not targets:
        return Examination((), ())
    search = paper_outlines if settings.method is Method.PAPER else find_rings
    rings = (ring for target in targets for ring in target.rings)
    candidates = find_dotted_rings(grey, search(grey, settings), rings)
    trials = [
        _try_target(
            grey, camera, candidates, target, settings, priors.get(target.name, PlatePrior())
        )
        for target in targets
    ]
    outcomes: list[Outcome] = []
    considered: list[Considered] = []
    for trial in trials:
        others = (other for other in trials if other is not trial)
        rivals = [*measured, *(plate for other in others for plate in other.plates)]
        own = _undisputed(trial.plates, rivals)
        free = [
            candidate
            for candidate in trial.considered
            if not any(rival.covers(candidate.outline) for rival in rivals)
        ]
        outcomes += own or (miss_of(grey, trial.target, free, settings, targets),)
        considered += trial.considered
    return Examination(tuple(outcomes), tuple(considered))


def _undisputed(
    plates: tuple[Measurement, ...], rivals: list[Measurement]
) -> tuple[Measurement, ...]:
    """Leave out plates that look more like another target; number the others by score."""
    kept = [
        plate
        for plate in plates
        if not any(rival.score > plate.score and _share_a_plate(rival, plate) for rival in rivals)
    ]
    kept.sort(key=lambda plate: -plate.score)
    return tuple(replace(plate, instance=i) for i, plate in enumerate(kept))


def _share_a_plate(first: Measurement, second: Measurement) -> bool:
    radius_px = max(first.appearance.radius_px, second.appearance.radius_px)
    return bool(np.linalg.norm(first.centre_px - second.centre_px) < radius_px)


def _try_target(
    grey: GreyArray,
    camera: Camera,
    candidates: dict[Ring, tuple[Candidate, ...]],
    target: Target,
    settings: DetectSettings,
    prior: PlatePrior,
) -> _Trial:
    """Measure all plates of one target, by a replica where the main ring is not measured."""
    plates: list[Measurement] = []
    considered: list[Considered] = []
    for ring in target.rings:
        free = (
            candidate
            for candidate in candidates[ring]
            if not any(plate.covers(candidate.outline) for plate in plates)
        )
        matches, refused = find_code(free, ring, settings)
        considered += [
            Considered(
                target.name,
                ring.name,
                refusal.outline,
                refusal.score,
                is_match=False,
                reason=refusal.reason,
                detail=refusal.detail,
            )
            for refusal in refused
        ]
        for match in matches:
            candidate = Considered(target.name, ring.name, match.outer, match.score, is_match=True)
            if any(plate.covers(match.outer) for plate in plates):
                continue
            try:
                plates.append(measure_match(grey, camera, target, match, settings, prior))
            except Rejection as rejection:
                candidate = replace(candidate, reason=rejection.reason, detail=rejection.detail)
            considered.append(candidate)
    return _Trial(target, tuple(plates), tuple(considered))


def measure_match(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    match: CodeMatch,
    settings: DetectSettings,
    prior: PlatePrior,
) -> Measurement:
    """Measure a matched ring by the method of the settings, and check that it is the target.

    Raises
    ------
    Rejection
        With the reason of the first test that fails.
    """
    if settings.method is Method.PAPER:
        measurement = measure_ring(grey, camera, target, match)
        _check_plate(grey, camera, target, match.ring, measurement.pose, settings)
        return measurement
    start = initial_pose(grey, camera, target, match)
    visible = _check_plate(grey, camera, target, match.ring, start.pose, settings)
    measurement = measure_by_model(grey, camera, target, start, prior, visible)
    check_false_alarm(measurement, target, match.ring, settings.false_alarm)
    return measurement


def _check_plate(
    grey: GreyArray,
    camera: Camera,
    target: Target,
    ring: Ring,
    pose: Pose,
    settings: DetectSettings,
) -> BoolArray | None:
    """Refuse a plate that does not look like the target; return where it is visible; None: all."""
    template_match = match_templates_at(grey, camera, pose, ring)
    template_match.check(settings.min_score)
    if ring is target.ring:
        return template_match.visible
    return _check_main_ring(grey, camera, target.ring, ring, pose, settings)


def miss_of(
    grey: GreyArray,
    target: Target,
    considered: Sequence[Considered],
    settings: DetectSettings,
    targets: Sequence[Target] = (),
) -> Miss:
    """Return why a target was not measured: the reason of its best candidate.

    Parameters
    ----------
    targets : sequence of Target
        All targets that may be seen: the candidate may carry the code of another one.
    """
    if not considered:
        return Miss(target.name, Reason.NO_CANDIDATE)
    best = ring_to_explain(target, considered)
    best = explain(grey, target, best, settings.min_radius_px, targets)
    outlines = {candidate.outline for candidate in considered}
    reason = best.reason or Reason.CODE_MISMATCH
    return Miss(target.name, reason, best.detail, best.score, len(outlines), best.outline)


def _check_main_ring(
    grey: GreyArray,
    camera: Camera,
    main: Ring,
    replica: Ring,
    pose: Pose,
    settings: DetectSettings,
) -> BoolArray | None:
    """Refuse a replica on a plate with another main code; return where the main ring is visible.

    Plates of several targets may carry the same small ring. If enough of the main ring is in the
    frame, it must show its code at the heading of the replica. None: it is not looked at, or all of
    it is visible.
    """
    points = points_of_code(camera, pose, main)
    height, width = grey.shape
    within = np.all((points >= 0.0) & (points <= (width - 1.0, height - 1.0)), axis=1)
    if within.mean() < _MIN_VISIBLE:
        return None
    score = fixed_lag_score(grey, points, within, main)
    if score >= _MIN_MAIN_SCORE:
        return None
    template_match = match_templates_at(grey, camera, pose, main)  # a part of it may be hidden
    turn_deg = abs((template_match.lag_deg + 180.0) % 360.0 - 180.0)
    if template_match.visible is None or turn_deg > _MOST_TURNED_DEG:
        raise Rejection(
            Reason.CODE_MISMATCH,
            f"the ring around the replica {replica.name} is not {main.name}: {score:.2f}",
        )
    template_match.check(settings.min_score)
    return template_match.visible
