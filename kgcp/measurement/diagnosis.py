"""Why the best candidate of a frame was not the target, in the words of the registry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.errors import Reason
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.measurement.records import Considered
from kgcp.measurement.search.template_match import CODE_LIKE, match_templates, polar_patch
from kgcp.measurement.search.templates import SAMPLED_RADII
from kgcp.targets.layout import Ring

# Shares from which on something is the reason why a target was not measured. They only choose the
# word of a miss: the sets of `benchmarks.search.hard_frames` are named for these words.
_CUT = 0.1  # of the outline outside the frame
_FAINT_DOTS = 0.25  # of the ring's contrast
_UNSEEN = 0.15  # of the outer edge
_SEEN, _EDGE_STEP = (
    0.75,
    0.4,
)  # quantile of steps that belongs to the visible part; less is not an edge
_BURNT = 0.9  # of the pixels on disc and plate
_INK, _PLATE, _HALF_BAND = 0.9, 1.1, 0.04  # circles either side of the outer edge, of its radius
_DISC = 0.8  # of the inner radius


def explain(grey: GreyArray, ring: Ring, candidate: Considered, min_radius_px: float) -> Considered:
    """Give a dropped candidate the reason that lies in the image, where one is plain to see.

    A ring that is hardly like the target keeps its reason: it is something else, and how it is
    seen does not matter. The detail begins with where the ring is.

    Parameters
    ----------
    ring : Ring
        What it was compared with.
    candidate : Considered
        Dropped by one of the tests.
    min_radius_px : float
        Smallest radius that is looked for [px].
    """
    outline = candidate.outline
    at = f"ring at ({outline.x:.0f}, {outline.y:.0f}), radius {outline.mean_radius:.1f} px"
    reason = candidate.reason
    finding = None
    if candidate.is_match or candidate.score >= CODE_LIKE:
        finding = _plain_cause(grey, ring, outline, min_radius_px)
    if finding is not None:
        reason, cause = finding
        at = f"{at}, {cause}"
    detail = f"{at}: {candidate.detail}" if candidate.detail else at
    return replace(candidate, reason=reason, detail=detail)


def _plain_cause(
    grey: GreyArray, ring: Ring, outline: Ellipse, min_radius_px: float
) -> tuple[Reason, str] | None:
    """Return the first cause that applies, of those that leave the least to measure first."""
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
    burnt = _share_burnt(patch, ring, float(np.iinfo(grey.dtype).max))
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
    return float(np.mean(step < _EDGE_STEP * np.quantile(step, _SEEN)))


def _share_burnt(patch: FloatArray, ring: Ring, limit: float) -> float:
    radii = SAMPLED_RADII
    white = patch[(radii < _DISC * ring.inner_ratio) | (radii > _PLATE - _HALF_BAND)]
    return float(np.mean(white >= limit))
