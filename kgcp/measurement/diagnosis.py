"""Why the best candidate of a frame was not measured as the target: one of the reasons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kgcp.errors import Reason
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.grey_range import full_scale
from kgcp.measurement.records import Considered
from kgcp.measurement.search.dot_reading import describe_dots, read_dots
from kgcp.measurement.search.template_match import MIN_SCORE_OF_A_CODE, match_templates, polar_patch
from kgcp.measurement.search.templates import SAMPLED_RADII
from kgcp.targets.layout import Ring, Target

# Limits beyond which something is the reason why a target was not measured. They only choose the
# reason of a miss; the sets of `benchmarks.search.hard_frames` are named after these reasons.
_CUT = 0.1  # share of the outline that is outside the frame
_FAINT_DOTS = 0.25  # contrast of the dots, relative to the ring's
_UNSEEN = 0.15  # share of the outer edge that is not seen
# This quantile of the steps of grey values across the outer edge stands for its visible part. Where
# a step is smaller than this share of it, the edge is not seen.
_VISIBLE_QUANTILE, _EDGE_STEP = 0.75, 0.4
_BURNT = 0.9  # share of burnt pixels on disc and plate
_INK, _PLATE, _HALF_BAND = 0.9, 1.1, 0.04  # circles either side of the outer edge, in its radii
_DISC = 0.8  # of the inner radius: pixels within show the inner disc
_WRONG_CODE = {Reason.OTHER_CODE, Reason.CODE_MISMATCH}
_CONCENTRIC, _SAME_SCALE = 0.3, 0.2  # largest offset in a replica's radii, and relative size error


def ring_to_explain(target: Target, considered: Sequence[Considered]) -> Considered:
    """Return the candidate whose failure explains a miss: the best one, or the main ring around it.

    A candidate that carries the code is better than any that does not, whatever their scores. But
    if the best one is a replica with its code, inside a main ring without its code, the miss is
    explained by the main ring.

    Parameters
    ----------
    considered : sequence of Considered
        At least one.
    """
    best = max(considered, key=lambda candidate: (candidate.is_match, candidate.score))
    around = (
        candidate
        for candidate in considered
        if candidate.ring == target.ring.name
        and candidate.score >= MIN_SCORE_OF_A_CODE
        and any(
            _encloses(candidate.outline, best.outline, target, ring) for ring in target.replicas
        )
    )
    return max(around, key=lambda candidate: candidate.score, default=best)


def _encloses(outer: Ellipse, inner: Ellipse, target: Target, replica: Ring) -> bool:
    """Tell whether two outlines lie as a target's main ring and its replica do."""
    scale = replica.outer_diameter_m / target.ring.outer_diameter_m
    offset_px = float(np.linalg.norm(outer.centre - inner.centre))
    return offset_px < _CONCENTRIC * inner.a and abs(scale * outer.a / inner.a - 1.0) < _SAME_SCALE


def explain(
    grey: GreyArray,
    target: Target,
    candidate: Considered,
    min_radius_px: float,
    targets: Sequence[Target] = (),
) -> Considered:
    """Give a dropped candidate a reason that is visible in the image, if there is one.

    A ring that is hardly like the target keeps its reason: it is something else, whatever its
    image. The detail begins with the place of the ring.

    Parameters
    ----------
    target : Target
        The target with whose ring it was compared.
    candidate : Considered
        Dropped by one of the tests.
    min_radius_px : float
        Smallest radius that is looked for [px].
    targets : sequence of Target
        All targets of the flight: the ring may carry the code of another one.
    """
    outline = candidate.outline
    ring = next(ring for ring in target.rings if ring.name == candidate.ring)
    at = f"ring at ({outline.x:.0f}, {outline.y:.0f}), radius {outline.mean_radius:.1f} px"
    reason = candidate.reason
    finding = None
    if candidate.is_match or candidate.score >= MIN_SCORE_OF_A_CODE:
        finding = _plain_cause(grey, ring, outline, min_radius_px)
    cause = None
    if finding is not None:
        reason, cause = finding
    elif reason in _WRONG_CODE and candidate.score >= MIN_SCORE_OF_A_CODE:
        cause = describe_dots(read_dots(grey, outline, ring), ring, target, targets)
    detail = at if cause is None else f"{at}, {cause}"
    if candidate.detail:
        detail = (
            f"{detail}: {candidate.detail}" if cause is None else f"{detail} ({candidate.detail})"
        )
    return replace(candidate, reason=reason, detail=detail)


def _plain_cause(
    grey: GreyArray, ring: Ring, outline: Ellipse, min_radius_px: float
) -> tuple[Reason, str] | None:
    """Return the first cause that applies, beginning with those that leave the least to measure."""
    outside = _share_outside(grey, outline)
    if outside > _CUT:
        return Reason.CUT, f"{outside:.0%} of it outside the frame"
    if outline.b < min_radius_px:
        return Reason.TOO_SMALL, f"{outline.b:.1f} px of {min_radius_px:g} px across"
    patch = polar_patch(grey, outline)
    template_match = match_templates(patch, ring, outline.a)
    unseen = _share_unseen(patch)
    if unseen > _UNSEEN:
        return Reason.HIDDEN, f"{unseen:.0%} of its edge not seen"
    if template_match.dot_contrast < _FAINT_DOTS:
        return Reason.TOO_BLURRED, f"dots of {template_match.dot_contrast:.0%} of the contrast"
    burnt = _share_burnt(patch, ring, full_scale(grey))
    if burnt > _BURNT:
        return Reason.CLIPPED, f"{burnt:.0%} of its white burnt out"
    return None


def _share_outside(grey: GreyArray, outline: Ellipse) -> float:
    contour = outline.points(np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False))
    limit = np.array(grey.shape[::-1]) - 1.0
    return float(np.mean(np.any((contour < 0.0) | (contour > limit), axis=1)))


def _share_unseen(patch: FloatArray) -> float:
    """Return the share of directions in which the light hardly rises at the outer edge."""
    ink, plate = (
        patch[np.abs(SAMPLED_RADII - middle) < _HALF_BAND].mean(axis=0) for middle in (_INK, _PLATE)
    )
    step = plate - ink
    return float(np.mean(step < _EDGE_STEP * np.quantile(step, _VISIBLE_QUANTILE)))


def _share_burnt(patch: FloatArray, ring: Ring, limit: float) -> float:
    radii = SAMPLED_RADII
    white = patch[(radii < _DISC * ring.inner_ratio) | (radii > _PLATE - _HALF_BAND)]
    return float(np.mean(white >= limit))
