"""Outlines of all discs and rings of a photograph: contours, edges along rays, ellipses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.ellipse_fit import fit_ellipses
from kgcp.geometry.grey_range import brightest_level
from kgcp.measurement.discs.blobs import find_blobs
from kgcp.measurement.discs.edge_points import (
    DIRECTIONS,
    RAYS,
    mark_inliers,
    sample_edges,
)
from kgcp.measurement.discs.records import (
    DiscOutline,
    Polarity,
    ellipse_of_moments,
)

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Tuning, as in `blobs`.
# How far from the ellipse edges are looked for, pass by pass: in radii, and at least and at most in
# pixels
_REACHES = (0.45, 0.25, 0.2)
_LEAST_REACHES_PX = (2.0, 1.5, 1.5)
_MOST_REACH_PX = 12.0
_LIMIT_PX, _LIMIT = 0.5, 0.04  # largest distance of an edge that counts: in pixels, and in radii
_LEAST_INLIERS = 0.8  # share of the rays whose edge counts
_RESIDUAL_PX, _RESIDUAL = 0.3, 0.012  # largest RMS distance: in pixels, and in radii
_LEAST_SEMI_AXIS_PX = 1.2
_MOST_ASPECT = 4.0
_LEAST_CONTRAST = 0.03  # of what is white in the photograph
# Two outlines are of the same edge if their centres are nearer than this (in radii) and the ratio
# of their radii is smaller than this.
_NEAR, _ALIKE = 0.3, 1.25
_CONCENTRIC = 0.2  # of the larger radius: how far the centre of a hole may be off
_LARGEST_HOLE = 0.95  # of the radius
# Sharpening leaves a faint edge on either side of an edge. With masks of σ = 1.1 px and strengths
# of 0.6 to 1.5, it is 2.4 to 3.7 px off and has 0.04 to 0.13 of the contrast. An outline that is
# nearer and fainter than the following limits is left out. A ring that is as narrow and has sides
# that differ as much looks the same, and loses its fainter edge.
_RIPPLE_PX, _RIPPLE = 4.0, 0.15


@dataclass(frozen=True, slots=True, eq=False)
class _FittedEdges:
    """Ellipses through edge points, for n candidates."""

    ellipses: FloatArray  # (n, 5): centre and symmetric stretch
    shares: FloatArray  # (n,): share of the rays whose edge is on the ellipse
    residual_px: FloatArray  # (n,): RMS distance of these edges
    contrast: FloatArray  # (n,): as a share of the grey values' range


def find_outlines(grey: GreyArray) -> tuple[DiscOutline, ...]:
    """Find the edges of all discs, rings and holes in a photograph, of both polarities.

    Parameters
    ----------
    grey : (height, width) array
        Grey values of 8 or 16 bits, or floats in 0…1.

    Returns
    -------
    tuple of DiscOutline
        From top to bottom and left to right. Each edge of a ring has an outline of its own.
    """
    blobs, polarities = find_blobs(grey)
    return _nested(_without_ripples(_follow(grey, blobs, polarities)))


def follow_outlines(
    grey: GreyArray, guesses: Sequence[DiscOutline], reach_px: float = 3.0
) -> tuple[DiscOutline | None, ...]:
    """Look for edges near predicted ones; None where there is none.

    Parameters
    ----------
    grey : (height, width) array
    guesses : sequence of DiscOutline
        Such as `DiscOutline.predicted`.
    reach_px : float
        How far an edge may be from its guess.
    """
    if not guesses:
        return ()
    ellipses = np.array([_stretched(each.ellipse) for each in guesses])
    signs = np.array([_sign(each.polarity) for each in guesses])
    # in the first pass a guess may be off by its whole reach, even if that is much of its radius
    reaches_px = [np.full(len(guesses), reach_px), None, None]
    fitted = _edges_of(grey, ellipses, signs, reaches_px)
    is_disc = _is_disc(fitted)
    axes = _semi_axes(fitted.ellipses)
    off_px = np.linalg.norm(fitted.ellipses[:, :2] - ellipses[:, :2], axis=1)
    off_px = np.maximum(off_px, np.abs(axes - _semi_axes(ellipses)).max(axis=1))
    return tuple(
        replace(_outline(fitted, i, guess.polarity), hole=guess.hole, is_hole=guess.is_hole)
        if is_disc[i] and off_px[i] <= reach_px
        else None
        for i, guess in enumerate(guesses)
    )


def _follow(
    grey: GreyArray, ellipses: FloatArray, polarities: Sequence[Polarity]
) -> list[DiscOutline]:
    """Return outlines of the candidates that are ellipses, only the best one of every edge."""
    if not len(ellipses):
        return []
    signs = np.array([_sign(each) for each in polarities])
    fitted = _edges_of(grey, ellipses, signs, [None] * len(_REACHES))
    chosen = _distinct(fitted, signs, np.flatnonzero(_is_disc(fitted)))
    return [_outline(fitted, i, polarities[i]) for i in chosen]


def _sign(polarity: Polarity) -> float:
    """Return the sign of the slope outwards."""
    return 1.0 if polarity is Polarity.DARK else -1.0


def _is_disc(fitted: _FittedEdges) -> BoolArray:
    """Tell which candidates (n,) have the edge of an ellipse."""
    axes = _semi_axes(fitted.ellipses)
    radius = np.sqrt(axes[:, 0] * axes[:, 1])
    is_disc = fitted.shares >= _LEAST_INLIERS
    is_disc &= fitted.residual_px <= np.hypot(_RESIDUAL_PX, _RESIDUAL * radius)
    is_disc &= (axes[:, 1] >= _LEAST_SEMI_AXIS_PX) & (axes[:, 0] <= _MOST_ASPECT * axes[:, 1])
    return np.asarray(is_disc & (fitted.contrast >= _LEAST_CONTRAST))


def _outline(fitted: _FittedEdges, i: int, polarity: Polarity) -> DiscOutline:
    contrast, residual_px = float(fitted.contrast[i]), float(fitted.residual_px[i])
    return DiscOutline(_ellipse(fitted.ellipses[i]), polarity, contrast, residual_px)


def _edges_of(
    grey: GreyArray,
    ellipses: FloatArray,
    signs: FloatArray,
    reaches_px: Sequence[FloatArray | None],
) -> _FittedEdges:
    """Fit ellipses to edges, in passes; each starts from the last and looks less far.

    `reaches_px` says how far, for each pass; None: in proportion to the radius.
    """
    image = np.ascontiguousarray(grey)
    count = len(ellipses)
    edges, strengths = np.empty((count, RAYS)), np.empty((count, RAYS))
    levels = np.empty((count, 2, RAYS))
    fitted, shares, residual_px = np.zeros((count, 5)), np.zeros(count), np.zeros(count)
    for reach, least, given_px in zip(_REACHES, _LEAST_REACHES_PX, reaches_px, strict=True):
        radius = np.sqrt(np.prod(_semi_axes(ellipses), axis=1))
        reach_px = np.clip(reach * radius, least, _MOST_REACH_PX) if given_px is None else given_px
        sample_edges(image, ellipses, signs, reach_px, edges, strengths, levels)
        inlying = strengths > 0.25 * np.median(strengths, axis=1, keepdims=True)
        # first with all strong edges, then twice with those near the fitted ellipse
        fit_ellipses(edges, inlying, DIRECTIONS, 2.0, fitted, shares)
        for limit in (2.0, 1.0):
            limits_px = limit * np.hypot(_LIMIT_PX, _LIMIT * radius)
            fitted[shares == 0.0] = (0.0, 0.0, 1.0, 1.0, 0.0)
            mark_inliers(edges, strengths, ellipses, fitted, limits_px, inlying, residual_px)
            fit_ellipses(edges, inlying, DIRECTIONS, 2.0, fitted, shares)
        fitted[shares == 0.0] = (0.0, 0.0, 1.0, 1.0, 0.0)
        mark_inliers(edges, strengths, ellipses, fitted, limits_px, inlying, residual_px)
        ellipses = _carried(ellipses, fitted)
    contrast = _contrast(levels, inlying) / brightest_level(grey)
    return _FittedEdges(
        ellipses, np.where(shares > 0.0, inlying.mean(axis=1), 0.0), residual_px, contrast
    )


def _contrast(levels: FloatArray, inlying: BoolArray) -> FloatArray:
    """Return the median difference (n,) of the levels (n, 2, rays) beside inlying edges."""
    steps = np.where(inlying, np.abs(levels[:, 1] - levels[:, 0]), np.nan)
    steps[~inlying.any(axis=1)] = 0.0
    return np.asarray(np.nanmedian(steps, axis=1))


def _carried(frames: FloatArray, fitted: FloatArray) -> FloatArray:
    """Return ellipses as centre and symmetric stretch (n, 5), fitted in the frames of others."""
    x, y, a, b, angle = fitted.T
    stretch = _matrices(frames)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack((np.stack((c, -s), axis=-1), np.stack((s, c), axis=-1)), axis=-2)
    carried = stretch @ turn * np.stack((a, b), axis=-1)[:, None, :]
    square = carried @ np.swapaxes(carried, 1, 2)
    # the symmetric root of a symmetric 2 × 2 matrix, by Cayley and Hamilton
    area = np.sqrt(np.maximum(np.linalg.det(square), 1e-12))
    trace = np.sqrt(np.trace(square, axis1=1, axis2=2) + 2.0 * area)
    root = (square + area[:, None, None] * np.eye(2)) / trace[:, None, None]
    centre = frames[:, :2] + np.einsum("nij,nj->ni", stretch, np.stack((x, y), axis=-1))
    return np.column_stack((centre, root[:, 0, 0], root[:, 0, 1], root[:, 1, 1]))


def _matrices(ellipses: FloatArray) -> FloatArray:
    return ellipses[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def _semi_axes(ellipses: FloatArray) -> FloatArray:
    """Return the larger and the smaller semi-axis (n, 2)."""
    xx, xy, yy = ellipses[:, 2:].T
    mean, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return np.column_stack((mean + half, np.maximum(mean - half, 0.0)))


def _stretched(ellipse: Ellipse) -> FloatArray:
    (xx, xy), (_, yy) = ellipse.stretch.tolist()
    return np.array((ellipse.x, ellipse.y, xx, xy, yy))


def _ellipse(values: FloatArray) -> Ellipse:
    x, y, xx, xy, yy = values.tolist()
    square = 0.25 * np.array((xx * xx + xy * xy, xy * (xx + yy), xy * xy + yy * yy))
    return ellipse_of_moments(np.array((x, y, *square)))


def tree_of(points: FloatArray) -> cKDTree:
    """Return a search tree of points (n, 2)."""
    from scipy.spatial import cKDTree  # 0.2 s to import, not needed without plain targets

    return cKDTree(points)


def _distinct(fitted: _FittedEdges, signs: FloatArray, candidates: IndexArray) -> list[int]:
    """Return the best candidate of every edge, in reading order."""
    best = sorted(candidates.tolist(), key=lambda i: (fitted.residual_px[i], i))
    if not best:
        return []
    centres, radius = (
        fitted.ellipses[best, :2],
        fitted.ellipses[:, 2:].take((0, 2), axis=1).mean(axis=1),
    )
    tree, kept, taken = tree_of(centres), [], np.zeros(len(best), np.bool_)
    for place, i in enumerate(best):
        if taken[place]:
            continue
        kept.append(i)
        for other in tree.query_ball_point(centres[place], _NEAR * radius[i]):
            j = best[other]
            ratio = radius[j] / radius[i]
            if signs[j] == signs[i] and 1.0 / _ALIKE < ratio < _ALIKE:
                taken[other] = True
    return sorted(kept, key=lambda i: (round(fitted.ellipses[i, 1]), fitted.ellipses[i, 0]))


def _without_ripples(outlines: list[DiscOutline]) -> list[DiscOutline]:
    """Leave out the faint edges that sharpening makes: they would hide the disc inside."""
    if not outlines:
        return []
    centres = np.array([each.ellipse.centre for each in outlines])
    radii = np.array([each.ellipse.mean_radius for each in outlines])
    tree = tree_of(centres)

    def is_ripple(i: int) -> bool:
        """Tell whether an outline is the faint edge that sharpening leaves beside another one."""
        return any(
            abs(radii[i] - radii[j]) <= _RIPPLE_PX
            and outlines[i].polarity is outlines[j].polarity.other
            and outlines[i].contrast < _RIPPLE * outlines[j].contrast
            for j in tree.query_ball_point(centres[i], _CONCENTRIC * radii[i])
        )

    return [outline for i, outline in enumerate(outlines) if not is_ripple(i)]


def _nested(outlines: list[DiscOutline]) -> tuple[DiscOutline, ...]:
    """Return the outlines with their holes: concentric edges of the other polarity inside."""
    if not outlines:
        return ()
    centres = np.array([each.ellipse.centre for each in outlines])
    radii = np.array([each.ellipse.mean_radius for each in outlines])
    tree, hole_of = tree_of(centres), {}
    for i, outline in enumerate(outlines):
        inside = [
            j
            for j in tree.query_ball_point(centres[i], _CONCENTRIC * radii[i])
            if radii[j] < _LARGEST_HOLE * radii[i]
            and outlines[j].polarity is outline.polarity.other
        ]
        if inside:
            hole_of[i] = max(inside, key=lambda j: radii[j])
    holes = set(hole_of.values())
    return tuple(
        replace(
            outline,
            hole=outlines[hole_of[i]].ellipse if i in hole_of else None,
            is_hole=i in holes,
        )
        for i, outline in enumerate(outlines)
    )
