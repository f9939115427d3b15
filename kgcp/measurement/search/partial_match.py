"""Rings of which something hides a part: where, and how well the rest fits."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.search.templates import (
    ANGLES,
    LOOKS,
    SAMPLED_RADII,
    SHIFTS,
    SingleArray,
    Templates,
    code_rows,
    cross_correlation,
    levels_by_shift,
    templates_of,
    twice_backwards,
)
from kgcp.targets.layout import Ring

_TYPICAL = 0.65  # quantile of steps of light that is not hidden, however much else is
_TYPICAL_RANK = round(_TYPICAL * (ANGLES - 1))
_MIN_STEP = 0.35  # of the typical one
_SHORTEST = 13  # samples; a dot that is too large takes less
_BORDER = 2  # samples beside a hidden part that blur may mix with it
_MOST_HIDDEN = 0.4
_DOTS_SEEN = 0.5  # of the code; that there are no others where the ring is seen counts as much
_OTHER_LAG = 6  # samples; a match farther off is another heading
_MARGIN = 0.04  # of the score, to other headings
_LIKE_CODE = 0.6  # correlation along the code circle; of hidden targets, it is above 0.75
_LOOK_OF_CODE = LOOKS.index((0.07, 1.0))


def visible_angles(seen: FloatArray, ring: Ring) -> BoolArray | None:
    """Tell at which angles a ring shows both of its edges.

    Parameters
    ----------
    seen : (rows, angles) array
        Grey values at the templates' radii.
    ring : Ring

    Returns
    -------
    (angles,) array of bool, or None
        None if nothing is hidden, or too much.
    """
    plate, outside, disc, inside = _edge_rows(ring)
    visible = np.empty(ANGLES, dtype=bool)
    hidden = _see(seen[plate] - seen[outside], seen[disc] - seen[inside], visible)
    return visible if 0 < hidden <= _MOST_HIDDEN * ANGLES else None


@lru_cache(maxsize=64)
def _edge_rows(ring: Ring) -> tuple[int, ...]:
    """Return the rows on either side of the outer edge, and of the inner one, bright ones first."""
    code = ring.code_diameter_m / ring.outer_diameter_m
    dot = ring.dot_diameter_m / ring.outer_diameter_m
    outside, inside = 0.5 * (1.0 + code + dot), 0.5 * (ring.inner_ratio + code - dot)
    radii = SAMPLED_RADII[SHIFTS:-SHIFTS]
    return tuple(
        int(np.abs(radii - ratio).argmin())
        for ratio in (1.1, outside, 0.85 * ring.inner_ratio, inside)
    )


@compiled
def _see(outwards: FloatArray, inwards: FloatArray, visible: BoolArray) -> int:
    """Fill in where the light rises at both edges, but for single samples; count the others."""
    least = _MIN_STEP * np.partition(outwards, _TYPICAL_RANK)[_TYPICAL_RANK]
    least_inwards = _MIN_STEP * np.partition(inwards, _TYPICAL_RANK)[_TYPICAL_RANK]
    for a in range(ANGLES):
        visible[a] = outwards[a] > least and inwards[a] > least_inwards
    core = np.zeros(ANGLES, np.bool_)
    length = 0
    for step in range(ANGLES + _SHORTEST - 1):  # of runs: also of those over the array's end
        length = 0 if visible[step % ANGLES] else length + 1
        if length >= _SHORTEST:
            core[(step - _SHORTEST // 2) % ANGLES] = True
    reach = _SHORTEST // 2 + _BORDER
    visible[:] = True
    for a in range(ANGLES):
        if core[a]:
            for step in range(-reach, reach + 1):
                visible[(a + step) % ANGLES] = False
    return int(ANGLES - visible.sum())


def may_show_code(patch: FloatArray, visible: BoolArray, ring: Ring, shift: int) -> bool:
    """Tell whether what is seen along the code circle resembles the code at any heading.

    Most rings of something else do not, and need no comparison with all templates.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    visible : (angles,) array of bool
    ring : Ring
    shift : int
        Of the template that fits the whole ring best.
    """
    first, last = code_rows(ring)
    seen = patch[shift + first : shift + last + 1].sum(axis=0)
    return _best_of_all_turns(seen, visible, _code_seen(ring)) > _LIKE_CODE


@lru_cache(maxsize=64)
def _code_seen(ring: Ring) -> FloatArray:
    """Return what a blurred ring shows along its code circle, backwards and twice around."""
    first, last = code_rows(ring)
    seen = templates_of(ring).images[_LOOK_OF_CODE, first : last + 1].sum(axis=0)
    return twice_backwards(seen)


@compiled
def _best_of_all_turns(seen: FloatArray, visible: BoolArray, backwards: FloatArray) -> float:
    """Return the largest normalised cross-correlation of what is visible, over all turns."""
    sums = np.zeros((3, ANGLES))
    count = mean = power = 0.0
    for a in range(ANGLES):
        if visible[a]:
            value, turned = seen[a], backwards[ANGLES - a : 2 * ANGLES - a]
            count, mean, power = count + 1.0, mean + value, power + value * value
            for lag in range(ANGLES):
                sums[0, lag] += turned[lag]
                sums[1, lag] += turned[lag] * turned[lag]
                sums[2, lag] += turned[lag] * value
    best = 0.0
    for lag in range(ANGLES):
        covariance = sums[2, lag] - mean * sums[0, lag] / count
        variance = sums[1, lag] - sums[0, lag] * sums[0, lag] / count
        best = max(best, covariance / math.sqrt(max(variance, 1e-9)))
    return best / math.sqrt(max(power - mean * mean / count, 1e-9))


def best_partial_template(
    patch: FloatArray, visible: BoolArray, ring: Ring
) -> tuple[float, int, int, int] | None:
    """Return score, template, shift and lag that fit the visible part of a patch best.

    None if the visible dots leave more than one heading, or if too few of them are seen.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    visible : (angles,) array of bool
    ring : Ring
    """
    score = _correlation(patch, visible, templates_of(ring))
    place, lag = divmod(int(score.argmax()), ANGLES)
    template, shift = divmod(place, 2 * SHIFTS + 1)
    best = float(score[place, lag])
    others = score.max(axis=0).take(
        np.arange(lag + _OTHER_LAG, lag + ANGLES - _OTHER_LAG + 1), mode="wrap"
    )
    at_dots = visible.take(
        [round(deg * ANGLES / 360.0) + lag for deg in ring.code_deg], mode="wrap"
    )
    if at_dots.sum() < _DOTS_SEEN * len(at_dots) or others.max() > best - _MARGIN:
        return None
    return best, template, shift, lag


def _correlation(patch: FloatArray, visible: BoolArray, templates: Templates) -> SingleArray:
    """Return the normalised cross-correlation of what is visible: (templates · shifts, lags)."""
    share = float(visible.mean())
    masked = patch * visible
    levels = levels_by_shift(masked, share, templates.weights)
    product = cross_correlation(masked, templates, 1.0 / (share * levels[1]))
    _normalise(product, templates.moments, visible, levels[0] / levels[1])
    return product


@compiled
def _normalise(
    product: SingleArray, moments: SingleArray, visible: BoolArray, level: FloatArray
) -> None:
    """Make correlations of mean products (templates · shifts, lags), where parts are not seen.

    `level` is the mean of what is seen, by shift, in units of its standard deviation.
    """
    templates, shifts = len(moments) // 2, len(level)
    sums = np.zeros((2 * templates, ANGLES), np.float32)
    sums[templates:] = 1.0  # all around, images have the mean 0 and the power 1
    for k in range(2 * templates):
        total = sums[k]
        for a in range(ANGLES):
            if not visible[a]:
                hidden = moments[k, ANGLES - a : 2 * ANGLES - a]
                for lag in range(ANGLES):
                    total[lag] -= hidden[lag]
    share = np.float32(visible.sum() / ANGLES)
    for t in range(templates):
        for lag in range(ANGLES):
            mean, power = sums[t, lag] / share, sums[templates + t, lag] / share
            sums[t, lag] = mean
            sums[templates + t, lag] = 1.0 / math.sqrt(max(power - mean * mean, 1e-12))
        means, factors = sums[t], sums[templates + t]
        for s in range(shifts):
            row, there = product[t * shifts + s], np.float32(level[s])
            for lag in range(ANGLES):
                row[lag] = (row[lag] - there * means[lag]) * factors[lag]
