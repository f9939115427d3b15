"""All targets of one frame: outlines of rings, codes and poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.settings import DetectSettings, Method
from kgcp.target.circles import paper_outlines
from kgcp.target.code import CodeMatch, fixed_lag_score
from kgcp.target.layout import Ring, Target
from kgcp.target.model import measure_by_model
from kgcp.target.observation import Miss, Observation, Outcome
from kgcp.target.paper import measure_ring, points_of_code
from kgcp.target.prior import NormalPrior
from kgcp.target.search import find_code, find_rings, verify

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
        in order of score, or one Miss with the reason of its best candidate.
    """
    search = paper_outlines if settings.method is Method.PAPER else find_rings
    outlines = search(grey, settings)
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
    rejections: list[tuple[float, Rejection]] = []
    refusals: list[tuple[float, Rejection]] = []
    for ring in target.rings:
        matches, refused = find_code(grey, outlines, ring, settings)
        refusals += [(refusal.score, refusal.rejection) for refusal in refused]
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
                rejections.append((match.score, rejection))
    if found:
        found.sort(key=lambda observation: -observation.score)
        return tuple(replace(observation, instance=i) for i, observation in enumerate(found))
    return (_miss(target, rejections or refusals),)


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


def _miss(target: Target, rejections: list[tuple[float, Rejection]]) -> Miss:
    """Give the reason of the best candidate, of those that got as far as any."""
    if not rejections:
        return Miss(target.name, Reason.NO_CANDIDATE)
    score, rejection = max(rejections, key=lambda scored: scored[0])
    return Miss(target.name, rejection.reason, rejection.detail, score)
