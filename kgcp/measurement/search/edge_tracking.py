"""Outer edges of dark rings, tracked along rays: one closed curve of few harmonics for each.

An outer edge is where the grey values rise most on the way out of the ring. On a single ray that
may be the rim of a dot, a shadow or clutter. Over all rays, the edge of one ring is a smooth curve
about its centre: an ellipse whose centre is a little off the seed's, and whose axes differ a
little, has to first order the distances of `harmonic_curves`, so that a robust linear fit of five
numbers tells the edge from the others. docs/method.md, "Edge tracking", derives it; `fit_ellipses`
puts the exact ellipse through what is left.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.harmonic_curves import TERMS, fill_in_medians, fit_curves, waves_of

# Tuning of the tracking. Lengths are in units of the seed's radius, which is right to a fifth.
# The benchmark is `benchmarks.search.hard_frames`; docs/method.md, "Constants of the search", has
# what it finds with other values.
RAYS = 40  # a ring of 6 px radius has about as many pixels along its edge
_RADII = np.arange(0.5, 1.71, 0.04)  # of samples: seeds are good to a fifth, tilts go to 45°
_STEP = 2  # samples either side that a slope is taken over: as wide as the blur of small rings
_EVERY = 2  # ray is looked at first: most seeds are not rings, which half of the rays shows
# Widths of the residuals' weights, pass by pass: wide at first, so that a seed that is off by a
# quarter of its radius still finds the curve; then as narrow as edges scatter.
_WIDTHS_AT_FIRST = np.array((0.25, 0.12, 0.07))
_WIDTHS = np.array((0.07, 0.05))
_REACH = 0.17  # of an edge from the first curve; the rises into dots are farther in
_INLIER = 0.07  # distance from the curve of what counts as its edge, twice that at first
_MIN_INLIERS, _MIN_INLIERS_AT_FIRST = 0.55, 0.6  # shares: up to 40 % may be hidden
FINEST_RADIUS_PX = 12.0
"""Least radius of rings in the image that they are tracked in; in the frame it may be less."""

_IntArray = npt.NDArray[np.signedinteger[Any]]

RAYS_RAD = 2.0 * np.pi / RAYS * np.arange(RAYS)
_FEW = RAYS // _EVERY
_MIDDLES = _RADII[_STEP:-_STEP]
_SPACING = _RADII[1] - _RADII[0]
_WAVES, _FEW_WAVES = waves_of(RAYS), waves_of(_FEW)
_HARMONICS = np.stack([np.ones(RAYS), *(f(k * RAYS_RAD) for k in (1, 2) for f in (np.cos, np.sin))])

# For the first look pixels are enough, and single precision, which does twice as many at a time.
# More samples of a ray, and more rays, fill up vectors.
_LANES = 32
_ROUGH_RADII = np.append(_RADII, np.full(_LANES - len(_RADII), _RADII[-1])).astype(np.float32)
_ROUGH_DIRECTIONS = _HARMONICS[1:3, ::_EVERY].astype(np.float32)
_SLOPES = len(_MIDDLES)
# Samples near a curve: of the slopes within reach either side, one more at either end for the
# parabola, and what the last of them reaches beyond.
_NEAR = int(2.0 * _REACH / _SPACING) + 1 + 2 + 2 * _STEP


def track_edges(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Look for the outer edges of rings: the steepest rises to brighter that lie on a curve.

    Each is tracked in the image in which its radius is 12 to 24 px: there a sample's spacing is
    half a pixel to one, and reduction has averaged the noise.

    Parameters
    ----------
    frame, reduced, levels
        Of a pyramid.
    centres, radii : (n, 2) and (n,) array
        Of the rings in the frame, roughly [px].

    Returns
    -------
    edges : (n, rays) array
        How far the edge is from the centre, of the radius.
    inlying : (n, rays) array of bool
        Which edges are on the curve; none at all if they are too few for a ring.
    """
    count = len(radii)
    curves = np.zeros((TERMS, count))
    numbers, rises = np.empty((_FEW, count), np.uint8), np.empty((_FEW, count), np.uint8)
    residuals = np.empty((_FEW, count))
    _find_rough_edges(frame, reduced, levels, centres, radii, numbers, rises)
    fill_in_medians(numbers, curves[0])
    curves[0] = _MIDDLES[0] + _SPACING * curves[0]
    fit_curves(_MIDDLES[numbers], rises, _FEW_WAVES, _WIDTHS_AT_FIRST, curves, residuals)
    on_curve = np.count_nonzero(np.abs(residuals) < 2.0 * _INLIER, axis=0)
    rings = np.flatnonzero(on_curve > _MIN_INLIERS_AT_FIRST * _FEW)

    near, curves = np.empty((RAYS, len(rings))), curves[:, rings]
    rises, residuals = np.empty((RAYS, len(rings)), np.uint8), np.empty((RAYS, len(rings)))
    images = frame, reduced, levels
    _find_edges_near(*images, centres[rings], radii[rings], curves, near, rises)
    middle = np.sort(near.T.copy(), axis=1)[:, RAYS // 2 - 1 : RAYS // 2 + 1]
    curves[0], curves[1:] = middle.mean(axis=1), 0.0
    fit_curves(near, rises, _WAVES, _WIDTHS, curves, residuals)
    on_curve = (np.abs(residuals) < _INLIER) & (rises > 0)
    on_curve &= np.count_nonzero(on_curve, axis=0) >= _MIN_INLIERS * RAYS
    edges, inlying = np.ones((count, RAYS)), np.zeros((count, RAYS), np.bool_)
    edges[rings], inlying[rings] = near.T, on_curve.T
    return edges, inlying


@inlined
def _octave_of(radius: float, levels: IndexArray) -> int:
    """Return how often a frame is halved where a ring is tracked."""
    octave, largest = 0, 2.0 * FINEST_RADIUS_PX
    while 2 * octave < len(levels) and radius >= largest:
        octave, largest = octave + 1, 2.0 * largest
    return octave


@compiled
def _find_rough_edges(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
    numbers: GreyArray,
    rises: GreyArray,
) -> None:
    """Fill in the numbers of the steepest rises outwards on some of the rays, and the rises."""
    places, values = np.empty((_FEW, _LANES), np.int32), np.zeros((_LANES, _LANES), np.int16)
    for i in range(len(radii)):
        octave = _octave_of(radii[i], levels)
        x, y = (centres[i, 0] + 0.5) / 2.0**octave - 0.5, (centres[i, 1] + 0.5) / 2.0**octave - 0.5
        radius, number, rise = radii[i] / 2.0**octave, numbers[:, i], rises[:, i]
        if octave == 0:  # apart, since the frame may be a read-only array: another type
            _find_rough_edge(frame, x, y, radius, places, values, number, rise)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            _find_rough_edge(image, x, y, radius, places, values, number, rise)


@compiled
def _find_rough_edge(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    places: _IntArray,
    values: _IntArray,
    number: GreyArray,
    rise: GreyArray,
) -> None:
    """Find the steepest rise outwards on some of the rays, in the pixels as they are.

    Addresses first, then grey values, then slopes: only the second cannot be vectorised, and a
    vector of what has just been stored one by one would have to wait for it. The steepest slope is
    found as one number: 32 times the slope, and so much less the farther out it is that of equal
    slopes the first is the largest.
    """
    pixels, width = image.reshape(-1), np.int32(image.shape[1])
    last_x, last_y = np.int32(width - 1), np.int32(image.shape[0] - 1)
    column, row = np.int32(math.floor(x + 0.5)), np.int32(math.floor(y + 0.5))
    rest_x, rest_y = np.float32(x + 0.5 - column), np.float32(y + 0.5 - row)
    for k in range(_FEW):
        dx = np.float32(radius) * _ROUGH_DIRECTIONS[0, k]
        dy = np.float32(radius) * _ROUGH_DIRECTIONS[1, k]
        for j in range(_LANES):
            # Each result is cast: sums of 32 bits would be of 64, and take twice the vectors.
            at_x = np.int32(column + np.int32(np.floor(rest_x + _ROUGH_RADII[j] * dx)))
            at_y = np.int32(row + np.int32(np.floor(rest_y + _ROUGH_RADII[j] * dy)))
            at_x = min(max(at_x, np.int32(0)), last_x)
            at_y = min(max(at_y, np.int32(0)), last_y)
            places[k, j] = np.int32(np.int32(at_y * width) + at_x)
    for k in range(_FEW):
        for j in range(_LANES):
            values[j, k] = pixels[np.uint32(places[k, j])]
    steepest = np.full(_LANES, np.int16(-(2**15)))
    for j in range(_SLOPES):
        outer, inner, countdown = values[j + 2 * _STEP], values[j], np.int16(_SLOPES - 1 - j)
        for k in range(_LANES):
            slope = np.int16(np.int16(32 * np.int16(outer[k] - inner[k])) + countdown)
            steepest[k] = max(steepest[k], slope)
    for k in range(_FEW):
        number[k] = _SLOPES - 1 - steepest[k] % 32
        rise[k] = max(steepest[k] >> 5, 0)


@compiled
def _find_edges_near(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
    curves: FloatArray,
    edges: FloatArray,
    rises: GreyArray,
) -> None:
    """Fill in the steepest rises outwards near curves, on all rays: (rays, n)."""
    work = (
        np.empty((_NEAR, RAYS), np.int32),
        np.empty((2, _NEAR, RAYS)),
        np.empty((4, _NEAR, RAYS), np.uint8),
        np.empty((_NEAR, RAYS)),
    )
    for i in range(len(radii)):
        octave = _octave_of(radii[i], levels)
        x, y = (centres[i, 0] + 0.5) / 2.0**octave - 0.5, (centres[i, 1] + 0.5) / 2.0**octave - 0.5
        radius, curve, edge, rise = radii[i] / 2.0**octave, curves[:, i], edges[:, i], rises[:, i]
        if octave == 0:  # apart, since the frame may be a read-only array: another type
            _find_edge_near(frame, x, y, radius, curve, work, edge, rise)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            _find_edge_near(image, x, y, radius, curve, work, edge, rise)


@compiled
def _find_edge_near(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    curve: FloatArray,
    work: tuple[_IntArray, FloatArray, GreyArray, FloatArray],
    edge: FloatArray,
    rise: GreyArray,
) -> None:
    """Find the steepest rise outwards within reach of a curve on all rays, between samples.

    Three slopes around the steepest give a parabola, whose maximum is the edge. Its rise is no more
    than a weight, and is rounded to a grey value.
    """
    places, parts, corners, values = work
    first, last = np.empty(RAYS, np.int32), np.empty(RAYS, np.int32)
    for k in range(RAYS):
        rho = 0.0
        for i in range(len(curve)):
            rho += curve[i] * _HARMONICS[i, k]
        first[k] = max(math.ceil((rho - _REACH - _MIDDLES[0]) / _SPACING), 1)
        last[k] = min(math.floor((rho + _REACH - _MIDDLES[0]) / _SPACING), _SLOPES - 2)
        edge[k], rise[k] = rho, 0
    _sample_rays(image, x, y, radius, first, places, parts, corners, values)
    for k in range(RAYS):
        if first[k] > last[k]:
            continue
        best, top = 1, values[1 + 2 * _STEP, k] - values[1, k]
        for j in range(2, last[k] - first[k] + 2):
            slope = values[j + 2 * _STEP, k] - values[j, k]
            best, top = (j, slope) if slope > top else (best, top)
        left = values[best - 1 + 2 * _STEP, k] - values[best - 1, k]
        right = values[best + 1 + 2 * _STEP, k] - values[best + 1, k]
        bend = min(left - 2.0 * top + right, -1e-3)
        beside = min(max(0.5 * (left - right) / bend, -0.5), 0.5)
        edge[k] = _MIDDLES[0] + _SPACING * (first[k] - 1 + best + beside)
        rise[k] = round(max(top, 0.0))


@compiled
def _sample_rays(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    first: _IntArray,
    places: _IntArray,
    parts: FloatArray,
    corners: GreyArray,
    values: FloatArray,
) -> None:
    """Fill in bilinear grey values along all rays; beyond the border the last pixels repeat.

    The image has two rows and columns at least, as those of a pyramid have.
    `places` and `parts` keep the pixels above and left of the samples, and how far these are beyond
    them; `corners` the four pixels around: loops of arithmetic alone are vectorised, one that also
    reads the image is not.
    """
    width, last_x, last_y = np.int32(image.shape[1]), image.shape[1] - 1, image.shape[0] - 1
    for j in range(_NEAR):
        place, right, below = places[j], parts[0, j], parts[1, j]
        for k in range(RAYS):
            rho = radius * (_RADII[0] + _SPACING * (first[k] - 1 + j))
            column = _clamp(x + rho * _HARMONICS[1, k], float(last_x))
            row = _clamp(y + rho * _HARMONICS[2, k], float(last_y))
            left = min(np.int32(column), np.int32(last_x - 1))
            top = min(np.int32(row), np.int32(last_y - 1))
            place[k] = np.int32(np.int32(top * width) + left)
            right[k], below[k] = column - left, row - top
    pixels = image.reshape(-1)
    for j in range(_NEAR):
        for k in range(RAYS):
            above = np.uintp(np.uint32(places[j, k]))
            below = above + np.uintp(image.shape[1])
            corners[0, j, k], corners[1, j, k] = pixels[above], pixels[above + np.uintp(1)]
            corners[2, j, k], corners[3, j, k] = pixels[below], pixels[below + np.uintp(1)]
    for j in range(_NEAR):
        upper_left, upper_right = corners[0, j], corners[1, j]
        lower_left, lower_right = corners[2, j], corners[3, j]
        value, right, below = values[j], parts[0, j], parts[1, j]
        for k in range(RAYS):
            upper = upper_left[k] + right[k] * (np.float64(upper_right[k]) - upper_left[k])
            lower = lower_left[k] + right[k] * (np.float64(lower_right[k]) - lower_left[k])
            value[k] = upper + below[k] * (lower - upper)


@inlined
def _clamp(value: float, most: float) -> float:
    """Return a value in 0…`most`; `min` and `max` check for NaN, which keeps loops from vectors."""
    if value < 0.0:
        return 0.0
    if value > most:
        return most
    return value
