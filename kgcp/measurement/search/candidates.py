"""Selection of the rings in a frame that carry the code of a target."""

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

# Tuning of the candidates. There are two benchmarks: `benchmarks.search.hard_frames` for the
# targets found (results in docs/method/search.md, "Constants of the search"), and
# `benchmarks.search.false_alarms`.
_MIN_CONTRAST = 0.02  # relative to the frame's white
_MIN_DOT_CONTRAST = 0.1  # relative to the ring's contrast; blur may leave so little of the dots
# Largest spread of the grey values of ink, of disc and of plate, relative to the contrast in full
# light. It allows for shade that leaves a sixth of the light.
_MAX_SPREAD = 0.85
# Disc and plate at the same angle get the same light, so their difference must vary little: over
# some half of the angles, by at most this share of the ring's depth. 900 targets, some of them half
# in shade, had up to 0.6; 99 % of the rings in textures have more than 0.4.
_MAX_DIFFERENCE_SPREAD = 0.7
_ROUNDING = 1.0  # grey values of that spread that rounding may cause
# Radii at which the disc and the plate are sampled, relative to the inner and to the outer radius.
_DISC_RADIUS, _PLATE_RADIUS = 0.8, 1.1
_ELLIPSE_SCORE_LOSS = 0.06  # of the score, since the outline ellipse replaces the true perspective
_WINDOW_REACH = 2.0  # of the searched window around expected places, in their radii
_MIN_WINDOW_PX = 12
_RATIO_DIGITS = 6  # to which proportions of rings are compared


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A dark ring with brighter spots, between a bright disc and a bright plate."""

    outline: Ellipse  # of its outer circle [px]
    # (radii, angles): polar samples of grey values, for `template_match.match_templates`
    patch: FloatArray


@dataclass(frozen=True, slots=True)
class RefusedCandidate:
    """A ring in the frame that does not carry the code."""

    outline: Ellipse  # of its outer circle [px]
    score: float  # normalised cross-correlation of the whole ring, -1…1
    # Why it was rejected. The exception is not kept, because its traceback would keep the frame in
    # memory.
    reason: Reason
    detail: str


def find_rings(grey: GreyArray, settings: DetectSettings) -> tuple[Ellipse, ...]:
    """Return the outlines of all dark rings in a frame that may belong to a target."""
    pyramid = build_pyramid(grey)
    return track_outlines(pyramid, find_seeds(pyramid, settings.min_radius_px))


def find_rings_at(
    grey: GreyArray, centres_px: FloatArray, radii_px: FloatArray
) -> tuple[Ellipse, ...]:
    """Return the outlines of rings near expected centres (n, 2), given approximate radii (n,).

    Faint rings are returned, too. Only the part of the frame around the centres is searched.
    """
    reach = _WINDOW_REACH * radii_px[:, None] + 1.0
    low = np.maximum(np.floor((centres_px - reach).min(axis=0)).astype(int), 0)
    x1, y1 = np.ceil((centres_px + reach).max(axis=0)).astype(int) + 1
    window = grey[low[1] : max(y1, 0), low[0] : max(x1, 0)]
    if min(window.shape) < _MIN_WINDOW_PX:
        return ()
    seeds = Seeds(centres_px - low, radii_px, np.ones(len(radii_px)))
    return tuple(
        replace(outline, x=outline.x + float(low[0]), y=outline.y + float(low[1]))
        for outline in track_outlines(build_pyramid(window), seeds)
    )


def find_dotted_rings(
    grey: GreyArray, outlines: tuple[Ellipse, ...], rings: Iterable[Ring]
) -> dict[Ring, tuple[Candidate, ...]]:
    """Return for each ring the outlines that look like a ring of its shape with dots.

    Their ink is dark between a bright disc and a bright plate, with brighter spots; the code is not
    compared. Rings with the same proportions, such as replicas, share their candidates.
    """
    min_contrast = _MIN_CONTRAST * brightest_level(grey)
    by_shape: dict[tuple[float, float], tuple[Candidate, ...]] = {}
    by_ring: dict[Ring, tuple[Candidate, ...]] = {}
    for ring in rings:
        ratios = ring.inner_ratio, ring.code_diameter_m / ring.outer_diameter_m
        shape = round(ratios[0], _RATIO_DIGITS), round(ratios[1], _RATIO_DIGITS)
        if shape not in by_shape:
            by_shape[shape] = _candidates_of_shape(grey, outlines, *ratios, min_contrast)
        by_ring[ring] = by_shape[shape]
    return by_ring


def find_code(
    candidates: Iterable[Candidate], ring: Ring, settings: DetectSettings
) -> tuple[tuple[CodeMatch, ...], tuple[RefusedCandidate, ...]]:
    """Look for a ring's code in all candidates.

    Returns
    -------
    matches : tuple of CodeMatch
        Best first.
    refused : tuple of RefusedCandidate
        The candidates that do not match.
    """
    matches: list[CodeMatch] = []
    refused: list[RefusedCandidate] = []
    for candidate in candidates:
        outline = candidate.outline
        template_match = match_templates(candidate.patch, ring, outline.a)
        try:
            template_match.check(settings.min_score - _ELLIPSE_SCORE_LOSS)
        except Rejection as rejection:
            reason, detail = rejection.reason, rejection.detail
            refused.append(RefusedCandidate(outline, template_match.score, reason, detail))
            continue
        matches.append(template_match.code_match(ring, outline))
    return tuple(sorted(matches, key=lambda match: -match.score)), tuple(refused)


def _candidates_of_shape(
    grey: GreyArray,
    outlines: tuple[Ellipse, ...],
    inner_ratio: float,
    code_ratio: float,
    min_contrast: float,
) -> tuple[Candidate, ...]:
    """Return the candidates for rings whose inner and code circles have these relative radii."""
    radii = np.array((_DISC_RADIUS * inner_ratio, code_ratio, _PLATE_RADIUS))
    values = sample_ellipses(grey, outlines, radii, CIRCLE)
    is_dotted = np.empty(len(outlines), dtype=bool)
    _mark_dotted(np.sort(values, axis=2), min_contrast, is_dotted)
    is_dotted[is_dotted] = _are_lit_alike(values[is_dotted])
    kept = tuple(outlines[i] for i in np.flatnonzero(is_dotted))
    return tuple(map(Candidate, kept, sample_ellipses(grey, kept, SAMPLED_RADII, CIRCLE)))


@compiled
def _mark_dotted(values: FloatArray, min_contrast: float, is_dotted: BoolArray) -> None:
    """Mark outlines whose grey values are consistent with a ring that has dots.

    `values` (n, 3, angles) are the sorted grey values on disc, code circle and plate. As in the
    ring check, quantiles measure ink and white, because dots, dirt and hidden parts shift means. On
    the code circle, the lower quartile is ink and the brightest 4 % are dots.
    """
    for i in range(len(values)):
        disc, code, plate = values[i, 0], values[i, 1], values[i, 2]
        black = code[_rank(0.25)]
        contrast = min(disc[_rank(0.5)], plate[_rank(0.5)]) - black
        disc_contrast, plate_contrast = disc[_rank(0.7)] - black, plate[_rank(0.8)] - black
        is_dotted[i] = (
            contrast > min_contrast
            and code[_rank(0.96)] - black > _MIN_DOT_CONTRAST * contrast
            and code[_rank(0.35)] - code[_rank(0.05)]
            < _MAX_SPREAD * min(disc_contrast, plate_contrast)
            and disc[_rank(0.7)] - disc[_rank(0.3)] < _MAX_SPREAD * disc_contrast
            and plate[_rank(0.8)] - plate[_rank(0.4)] < _MAX_SPREAD * plate_contrast
        )


def _are_lit_alike(values: FloatArray) -> BoolArray:
    """Return for each outline whether disc and plate are lit alike at half of the angles.

    Light and shade fall on disc and plate alike at any angle, whereas two circles in a texture are
    unrelated. `values` (n, 3, angles) are grey values on disc, code circle and plate.
    """
    disc, code, plate = values[:, 0], values[:, 1], values[:, 2]
    differences, half = np.sort(disc - plate, axis=1), ANGLES // 2
    spreads = (differences[:, half:] - differences[:, :-half]).min(axis=1)
    rank = _rank(0.67)
    depths = np.partition(np.minimum(disc, plate) - code, rank, axis=1)[:, rank]
    return np.asarray(spreads - _ROUNDING < _MAX_DIFFERENCE_SPREAD * depths)


@inlined
def _rank(quantile: float) -> int:
    return round(quantile * (ANGLES - 1))
