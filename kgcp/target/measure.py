"""All targets of one frame: outlines of rings, codes and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.settings import DetectSettings, Method
from kgcp.target.code import CodeMatch, fixed_lag_score
from kgcp.target.layout import Ring, Target
from kgcp.target.model import measure_by_model
from kgcp.target.observation import Miss, Observation, Outcome
from kgcp.target.paper import measure_ring, points_of_code
from kgcp.target.prior import NormalPrior
from kgcp.target.search import find_code, find_rings, verify

# How far the chain got: of several rejections the last in this order says most.
_STAGES = (
    Reason.NO_CANDIDATE,
    Reason.CODE_MISMATCH,
    Reason.OTHER_CODE,
    Reason.EDGES_LOST,
    Reason.NO_INNER_CIRCLE,
    Reason.POOR_ELLIPSE,
    Reason.IMPOSSIBLE_GEOMETRY,
    Reason.CUT,
    Reason.NO_CONTRAST,
    Reason.POOR_FIT,
)
_MIN_VISIBLE = 0.3  # of the main ring's code circle, for a replica to be held against it
_MIN_MAIN_SCORE = 0.75


def measure_frame(
    grey: GreyArray,
    camera: Camera,
    targets: tuple[Target, ...],
    settings: DetectSettings,
    prior: NormalPrior | None = None,
) -> tuple[Outcome, ...]:
    """Look for every target in a frame and measure what is found.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame, uint8 or uint16, of the camera's size.
    camera : Camera
        Interior orientation.
    targets : tuple of Target
        All that may be seen.
    settings : DetectSettings
        Of the search.
    prior : NormalPrior, optional
        Of the normal of the plate on the vehicle: of all targets without a position of their own.

    Returns
    -------
    tuple of Outcome
        In the order of the targets; of each either its plates as observations, instance 0, 1, …
        in order of score, or one Miss with the reason that got farthest.
    """
    outlines = find_rings(grey, settings)
    return tuple(
        outcome
        for target in targets
        for outcome in measure_target(
            grey, camera, outlines, target, settings, prior if target.position_m is None else None
        )
    )


def measure_target(
    grey: GreyArray,
    camera: Camera,
    outlines: tuple[Ellipse, ...],
    target: Target,
    settings: DetectSettings,
    prior: NormalPrior | None,
) -> tuple[Outcome, ...]:
    """Measure all plates of one target; its replicas serve where the main ring cannot."""
    found: list[Observation] = []
    rejections: list[Rejection] = []
    scores: list[float] = []
    for ring in target.rings:
        matches, refused = find_code(grey, outlines, ring, settings)
        rejections += [rejection for _, rejection in refused]
        scores += [score for score, _ in refused] + [match.score for match in matches]
        for match in matches:
            if any(_on_plate(match, observation) for observation in found):
                continue
            try:
                observation = measure_ring(grey, camera, target, match)
                verify(grey, camera, observation.pose, ring, settings)
                if ring is not target.ring:
                    _check_main_ring(grey, camera, target.ring, observation)
                if settings.method is Method.MODEL:
                    observation = measure_by_model(grey, camera, target, observation, prior)
                found.append(observation)
            except Rejection as rejection:
                rejections.append(rejection)
    if found:
        found.sort(key=lambda observation: -observation.score)
        return tuple(replace(observation, instance=i) for i, observation in enumerate(found))
    return (_miss(target, rejections, scores),)


def _on_plate(match: CodeMatch, observation: Observation) -> bool:
    """Tell whether a match lies on a plate that is measured already."""
    offset = np.linalg.norm(match.outer.centre - observation.centre_px)
    return bool(offset < observation.appearance.radius_px)


def _check_main_ring(grey: GreyArray, camera: Camera, main: Ring, observation: Observation) -> None:
    """Refuse a replica that sits on a plate with another main code.

    Plates of several targets may carry the same small ring. Where enough of the main ring is in
    the frame it must show its code at the heading of the replica.
    """
    points = points_of_code(camera, observation.pose, main)
    height, width = grey.shape
    visible = np.all((points >= 0.0) & (points <= (width - 1.0, height - 1.0)), axis=1)
    if visible.mean() < _MIN_VISIBLE:
        return
    score = fixed_lag_score(grey, points, visible, main)
    if score < _MIN_MAIN_SCORE:
        raise Rejection(
            Reason.CODE_MISMATCH,
            f"the ring around the replica {observation.ring} is not {main.name}: {score:.2f}",
        )


def _miss(target: Target, rejections: list[Rejection], scores: list[float]) -> Miss:
    best = max(scores, default=None)
    if rejections:
        farthest = max(rejections, key=lambda rejection: _STAGES.index(rejection.reason))
    elif best is not None:
        farthest = Rejection(Reason.CODE_MISMATCH, f"best score {best:.2f}")
    else:
        farthest = Rejection(Reason.NO_CANDIDATE)
    return Miss(target.name, farthest.reason, farthest.detail, best)
