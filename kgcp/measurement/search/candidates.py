"""Selection of the rings in a frame that carry a target's code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.grey_range import brightest_level
from kgcp.measurement.search.code_signal import CodeMatch
from kgcp.measurement.search.outlines import Seeds, find_seeds, track_outlines
from kgcp.measurement.search.pyramid import build_pyramid
from kgcp.measurement.search.sampling import sample_ellipses
from kgcp.measurement.search.template_match import match_templates
from kgcp.measurement.search.templates import ANGLES, CIRCLE, SAMPLED_RADII
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring

# Tuning of the candidates. Its benchmarks are `benchmarks.search.hard_frames`, for what is found
# (values in docs/method.md, "Constants of the search"), and `benchmarks.search.false_alarms`.
_MIN_CONTRAST = 0.02  # of what is white in the frame
_MIN_DOT_CONTRAST = 0.1  # of the ring's contrast: what blur leaves of dots
_UNEVEN = 0.85  # spread of ink, disc and plate, of the contrast in light: shade leaves a sixth
# Spread of what disc and plate differ by, over half of the angles, of the ring's depth: up to 0.6
# for 900 targets, half in shade or not, and from 0.4 on for 99 % of rings in textures
_MOST_APART = 0.7
_ROUNDING = 1.0  # of that spread, in grey values
_DISC_SHARE, _PLATE = 0.8, 1.1  # where the plate is seen, of the inner and of the outer radius
_CIRCLE_LOSS = 0.06  # of the score, where an ellipse stands for the true perspective
_SEED_REACH = 2.0  # around expected places, of their radii
_SMALLEST_WINDOW_PX = 12
_DIGITS = 6  # of proportions that are the same


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A dark ring with brighter places, between a bright disc and a bright plate."""

    outline: Ellipse  # of its outer circle [px]
    # (radii, angles): grey values around it, for
    # `kgcp.measurement.search.template_match.match_templates`
    patch: FloatArray


@dataclass(frozen=True, slots=True)
class Refusal:
    """A ring in the frame that is not the one looked for."""

    outline: Ellipse  # of its outer circle [px]
    score: float  # normalised cross-correlation of the whole ring, -1…1
    # what speaks against it; not the exception, whose traceback would keep the frame
    reason: Reason
    detail: str


def find_rings(grey: GreyArray, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return the outlines of all dark rings in a frame that may be a target's."""
    pyramid = build_pyramid(grey)
    return track_outlines(pyramid, find_seeds(pyramid, settings.min_radius_px))


def find_rings_at(
    grey: GreyArray, centres_px: FloatArray, radii_px: FloatArray
) -> tuple[Ellipse, ...]:
    """Return the outlines of rings at places (n, 2) of about some radii (n,), however faint.

    Nothing but the part of the frame around them is looked at.
    """
    reach = _SEED_REACH * radii_px[:, None] + 1.0
    low = np.maximum(np.floor((centres_px - reach).min(axis=0)).astype(int), 0)
    x1, y1 = np.ceil((centres_px + reach).max(axis=0)).astype(int) + 1
    window = grey[low[1] : max(y1, 0), low[0] : max(x1, 0)]
    if min(window.shape) < _SMALLEST_WINDOW_PX:
        return ()
    seeds = Seeds(centres_px - low, radii_px, np.ones(len(radii_px)))
    return tuple(
        replace(outline, x=outline.x + float(low[0]), y=outline.y + float(low[1]))
        for outline in track_outlines(build_pyramid(window), seeds)
    )


def find_dotted(
    grey: GreyArray, outlines: tuple[Ellipse, ...], rings: Iterable[Ring]
) -> dict[Ring, tuple[Candidate, ...]]:
    """Return for each ring the outlines that look like it but for their code.

    They have a dark ring between bright disc and plate, brighter in places. Rings of the same
    proportions, such as replicas, share their candidates.
    """
    least_contrast = _MIN_CONTRAST * brightest_level(grey)
    by_shape: dict[tuple[float, float], tuple[Candidate, ...]] = {}
    by_ring: dict[Ring, tuple[Candidate, ...]] = {}
    for ring in rings:
        ratios = ring.inner_ratio, ring.code_diameter_m / ring.outer_diameter_m
        shape = round(ratios[0], _DIGITS), round(ratios[1], _DIGITS)
        if shape not in by_shape:
            by_shape[shape] = _dotted(grey, outlines, *ratios, least_contrast)
        by_ring[ring] = by_shape[shape]
    return by_ring


def find_code(
    candidates: Iterable[Candidate], ring: Ring, settings: DetectSettings
) -> tuple[tuple[CodeMatch, ...], tuple[Refusal, ...]]:
    """Look for a ring's code in all candidates.

    Returns
    -------
    matches : tuple of CodeMatch
        Best first.
    refused : tuple of Refusal
        The others.
    """
    matches: list[CodeMatch] = []
    refused: list[Refusal] = []
    for candidate in candidates:
        outline = candidate.outline
        template_match = match_templates(candidate.patch, ring, outline.a)
        try:
            template_match.check(settings.min_score - _CIRCLE_LOSS)
        except Rejection as rejection:
            reason, detail = rejection.reason, rejection.detail
            refused.append(Refusal(outline, template_match.score, reason, detail))
            continue
        matches.append(template_match.code_match(ring, outline))
    return tuple(sorted(matches, key=lambda match: -match.score)), tuple(refused)


def _dotted(
    grey: GreyArray,
    outlines: tuple[Ellipse, ...],
    inner: float,
    code: float,
    least_contrast: float,
) -> tuple[Candidate, ...]:
    """Return the candidates for rings with such circles, of their outer radius."""
    radii = np.array((_DISC_SHARE * inner, code, _PLATE))
    values = sample_ellipses(grey, outlines, radii, CIRCLE)
    dotted = np.empty(len(outlines), dtype=bool)
    _mark_dotted(np.sort(values, axis=2), least_contrast, dotted)
    dotted[dotted] = _are_alike_inside_and_outside(values[dotted])
    kept = tuple(outlines[i] for i in np.flatnonzero(dotted))
    return tuple(map(Candidate, kept, sample_ellipses(grey, kept, SAMPLED_RADII, CIRCLE)))


@compiled
def _mark_dotted(values: FloatArray, least: float, dotted: BoolArray) -> None:
    """Mark outlines whose grey values, sorted, are consistent with a ring that has dots.

    `values` (n, 3, angles) are those on disc, code circle and plate. As in the ring check, order
    statistics stand for ink and white, since dots, dirt and hidden parts move means: a quarter up
    from the darkest of the code circle is ink, the brightest 4 % are dots.
    """
    for i in range(len(values)):
        disc, code, plate = values[i, 0], values[i, 1], values[i, 2]
        black = code[_rank(0.25)]
        contrast = min(disc[_rank(0.5)], plate[_rank(0.5)]) - black
        brightest_disc, brightest_plate = disc[_rank(0.7)] - black, plate[_rank(0.8)] - black
        dotted[i] = (
            contrast > least
            and code[_rank(0.96)] - black > _MIN_DOT_CONTRAST * contrast
            and code[_rank(0.35)] - code[_rank(0.05)]
            < _UNEVEN * min(brightest_disc, brightest_plate)
            and disc[_rank(0.7)] - disc[_rank(0.3)] < _UNEVEN * brightest_disc
            and plate[_rank(0.8)] - plate[_rank(0.4)] < _UNEVEN * brightest_plate
        )


def _are_alike_inside_and_outside(values: FloatArray) -> BoolArray:
    """Return of which outlines disc and plate are lit alike at most angles, as they are in shade.

    What falls on the plate at an angle falls on the disc, too, while two circles in a texture know
    nothing of each other. `values` (n, 3, angles) are grey values on disc, code circle and plate.
    """
    disc, code, plate = values[:, 0], values[:, 1], values[:, 2]
    differences, half = np.sort(disc - plate, axis=1), ANGLES // 2
    spreads = (differences[:, half:] - differences[:, :-half]).min(axis=1)
    rank = _rank(0.67)
    depths = np.partition(np.minimum(disc, plate) - code, rank, axis=1)[:, rank]
    return np.asarray(spreads - _ROUNDING < _MOST_APART * depths)


@inlined
def _rank(share: float) -> int:
    return round(share * (ANGLES - 1))
