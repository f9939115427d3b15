"""Outer edges of dark rings, tracked along rays from a seed.

The outer edge is where the grey values increase most on the way outwards. On a single ray this may
also be the rim of a dot, a shadow or clutter. Over all rays, however, the edge of a ring is a
smooth closed curve: an ellipse that is slightly off the seed's centre and slightly elongated has,
to first order, the distances that `harmonic_curves` models with five parameters. A robust linear
fit of these separates the edge from the rest. docs/method/search.md, "Edge tracking", derives it.
Afterwards `fit_ellipses` fits the exact ellipse to the edge points that remain.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.harmonic_curves import TERMS, fill_in_medians, fit_curves, waves_of

# Tuning of the tracking. Lengths are relative to the seed's radius, which is accurate to a fifth.
# The benchmark is `benchmarks.search.hard_frames`; docs/method/search.md, "Constants of the
# search", has its results with other values.
# Tracking has two stages. The first uses every second ray and whole pixels: most seeds are not
# rings, and half of the rays is enough to see that. The second uses all rays, near the first curve.
RAYS = 40  # a ring of 6 px radius has about as many pixels along its edge
_RADII = np.arange(0.5, 1.71, 0.04)  # of samples; covers seeds off by a fifth, and tilts of 45°
_HALF_BASE = 2  # samples on either side for a slope; the base is as wide as the blur of small rings
_FIRST_RAY_STEP = 2
# Widths of the residual weights, pass by pass. They are wide at first, so that a seed that is off
# by a quarter of its radius still finds the curve. The last ones correspond to the scatter of
# edges.
_FIRST_WIDTHS = np.array((0.25, 0.12, 0.07))
_WIDTHS = np.array((0.07, 0.05))
_REACH = 0.17  # of the second stage, from the first curve; the rims of dots are farther inside
_INLIER = 0.07  # largest distance of an edge point from the curve; in the first stage twice that
_MIN_INLIERS, _FIRST_MIN_INLIERS = 0.55, 0.6  # shares of the rays; up to 40 % may be hidden
MIN_TRACKED_RADIUS_PX = 12.0
"""Rings are tracked in the most reduced image in which their radius is at least this."""

_IntArray = npt.NDArray[np.signedinteger[Any]]

RAYS_RAD = 2.0 * np.pi / RAYS * np.arange(RAYS)
_FIRST_RAYS = RAYS // _FIRST_RAY_STEP
_MIDDLES = _RADII[_HALF_BASE:-_HALF_BASE]
_SPACING = _RADII[1] - _RADII[0]
_WAVES, _FIRST_WAVES = waves_of(RAYS), waves_of(_FIRST_RAYS)
_HARMONICS = np.stack([np.ones(RAYS), *(f(k * RAYS_RAD) for k in (1, 2) for f in (np.cos, np.sin))])

# The first stage works in single precision, in which vector instructions handle twice as many
# numbers. Samples and rays are padded to whole vectors.
_LANES = 32
_FIRST_RADII = np.append(_RADII, np.full(_LANES - len(_RADII), _RADII[-1])).astype(np.float32)
_FIRST_DIRECTIONS = _HARMONICS[1:3, ::_FIRST_RAY_STEP].astype(np.float32)
_SLOPES = len(_MIDDLES)
# Number of samples per ray near a curve: the slopes within reach, one more slope at either end for
# the parabola, and the base of the slopes.
_SAMPLES_NEAR = int(2.0 * _REACH / _SPACING) + 1 + 2 + 2 * _HALF_BASE


def track_edges(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Find the outer edges of rings: the steepest increases of grey values that lie on one curve.

    Each ring is tracked in the image in which its radius is 12 to 24 px. There the samples are half
    a pixel to one pixel apart, and the reduction has averaged the noise.

    Parameters
    ----------
    frame, reduced, levels
        As in `Pyramid`.
    centres, radii : (n, 2) and (n,) arrays
        Approximate centres and radii of the rings in the frame [px].

    Returns
    -------
    edges : (n, rays) array
        Distances of the edge from the centre, relative to the radius.
    inlying : (n, rays) array of bool
        Which edge points lie on the curve; none if there are too few for a ring.
    """
    count = len(radii)
    curves = np.zeros((TERMS, count))
    indices, rises = (
        np.empty((_FIRST_RAYS, count), np.uint8),
        np.empty((_FIRST_RAYS, count), np.uint8),
    )
    residuals = np.empty((_FIRST_RAYS, count))
    _find_first_edges(frame, reduced, levels, centres, radii, indices, rises)
    fill_in_medians(indices, curves[0])
    curves[0] = _MIDDLES[0] + _SPACING * curves[0]
    fit_curves(_MIDDLES[indices], rises, _FIRST_WAVES, _FIRST_WIDTHS, curves, residuals)
    on_curve = np.count_nonzero(np.abs(residuals) < 2.0 * _INLIER, axis=0)
    rings = np.flatnonzero(on_curve > _FIRST_MIN_INLIERS * _FIRST_RAYS)

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
    """Return how many times the frame is halved to track a ring of this radius [px]."""
    octave, largest = 0, 2.0 * MIN_TRACKED_RADIUS_PX
    while 2 * octave < len(levels) and radius >= largest:
        octave, largest = octave + 1, 2.0 * largest
    return octave


@compiled
def _find_first_edges(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
    indices: GreyArray,
    rises: GreyArray,
) -> None:
    """Fill in the steepest increases outwards on every second ray: sample numbers and sizes."""
    places, values = np.empty((_FIRST_RAYS, _LANES), np.int32), np.zeros((_LANES, _LANES), np.int16)
    for i in range(len(radii)):
        octave = _octave_of(radii[i], levels)
        x, y = (centres[i, 0] + 0.5) / 2.0**octave - 0.5, (centres[i, 1] + 0.5) / 2.0**octave - 0.5
        radius, index, rise = radii[i] / 2.0**octave, indices[:, i], rises[:, i]
        if octave == 0:  # separate: the frame may be read-only, which is another type for numba
            _find_first_edge(frame, x, y, radius, places, values, index, rise)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            _find_first_edge(image, x, y, radius, places, values, index, rise)


@compiled
def _find_first_edge(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    places: _IntArray,
    values: _IntArray,
    index: GreyArray,
    rise: GreyArray,
) -> None:
    """Find the steepest increase outwards on every second ray, without interpolation.

    There are separate loops for addresses, grey values and slopes. Only that for grey values cannot
    be vectorised.

    Slope and position are compared as one integer: 32 times the slope plus a countdown of the
    position, so that the innermost of equal slopes is the largest number.
    """
    pixels, width = image.reshape(-1), np.int32(image.shape[1])
    last_x, last_y = np.int32(width - 1), np.int32(image.shape[0] - 1)
    column, row = np.int32(math.floor(x + 0.5)), np.int32(math.floor(y + 0.5))
    rest_x, rest_y = np.float32(x + 0.5 - column), np.float32(y + 0.5 - row)
    for k in range(_FIRST_RAYS):
        dx = np.float32(radius) * _FIRST_DIRECTIONS[0, k]
        dy = np.float32(radius) * _FIRST_DIRECTIONS[1, k]
        for j in range(_LANES):
            # Results are cast because numba widens sums to 64 bits, which take twice the vectors.
            at_x = np.int32(column + np.int32(np.floor(rest_x + _FIRST_RADII[j] * dx)))
            at_y = np.int32(row + np.int32(np.floor(rest_y + _FIRST_RADII[j] * dy)))
            at_x = min(max(at_x, np.int32(0)), last_x)
            at_y = min(max(at_y, np.int32(0)), last_y)
            places[k, j] = np.int32(np.int32(at_y * width) + at_x)
    for k in range(_FIRST_RAYS):
        for j in range(_LANES):
            values[j, k] = pixels[np.uint32(places[k, j])]
    steepest = np.full(_LANES, np.int16(-(2**15)))
    for j in range(_SLOPES):
        outer, inner, countdown = values[j + 2 * _HALF_BASE], values[j], np.int16(_SLOPES - 1 - j)
        for k in range(_LANES):
            slope = np.int16(np.int16(32 * np.int16(outer[k] - inner[k])) + countdown)
            steepest[k] = max(steepest[k], slope)
    for k in range(_FIRST_RAYS):
        index[k] = _SLOPES - 1 - steepest[k] % 32
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
    """Fill in the steepest increases outwards near curves, on all rays: (rays, n)."""
    work = (
        np.empty((_SAMPLES_NEAR, RAYS), np.int32),
        np.empty((2, _SAMPLES_NEAR, RAYS)),
        np.empty((4, _SAMPLES_NEAR, RAYS), np.uint8),
        np.empty((_SAMPLES_NEAR, RAYS)),
    )
    for i in range(len(radii)):
        octave = _octave_of(radii[i], levels)
        x, y = (centres[i, 0] + 0.5) / 2.0**octave - 0.5, (centres[i, 1] + 0.5) / 2.0**octave - 0.5
        radius, curve, edge, rise = radii[i] / 2.0**octave, curves[:, i], edges[:, i], rises[:, i]
        if octave == 0:  # separate: the frame may be read-only, which is another type for numba
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
    """Find the steepest increase outwards near a curve on all rays, to a fraction of a sample.

    The edge is the maximum of a parabola through the steepest slope and its two neighbours. The
    size of the increase only serves as a weight, so it is rounded to whole grey values.
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
        best, top = 1, values[1 + 2 * _HALF_BASE, k] - values[1, k]
        for j in range(2, last[k] - first[k] + 2):
            slope = values[j + 2 * _HALF_BASE, k] - values[j, k]
            best, top = (j, slope) if slope > top else (best, top)
        left = values[best - 1 + 2 * _HALF_BASE, k] - values[best - 1, k]
        right = values[best + 1 + 2 * _HALF_BASE, k] - values[best + 1, k]
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
    """Fill in bilinear grey values along all rays; border pixels are repeated beyond the image.

    The image must have at least two rows and columns, as all images of a pyramid do. There are
    separate loops, because only those without memory gathers are vectorised. `places` keeps the
    pixel above and to the left of each sample, `parts` the sample's offsets from it, and `corners`
    the four surrounding grey values.
    """
    width, last_x, last_y = np.int32(image.shape[1]), image.shape[1] - 1, image.shape[0] - 1
    for j in range(_SAMPLES_NEAR):
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
    for j in range(_SAMPLES_NEAR):
        for k in range(RAYS):
            above = np.uintp(np.uint32(places[j, k]))
            below = above + np.uintp(image.shape[1])
            corners[0, j, k], corners[1, j, k] = pixels[above], pixels[above + np.uintp(1)]
            corners[2, j, k], corners[3, j, k] = pixels[below], pixels[below + np.uintp(1)]
    for j in range(_SAMPLES_NEAR):
        upper_left, upper_right = corners[0, j], corners[1, j]
        lower_left, lower_right = corners[2, j], corners[3, j]
        value, right, below = values[j], parts[0, j], parts[1, j]
        for k in range(RAYS):
            upper = upper_left[k] + right[k] * (np.float64(upper_right[k]) - upper_left[k])
            lower = lower_left[k] + right[k] * (np.float64(lower_right[k]) - lower_left[k])
            value[k] = upper + below[k] * (lower - upper)


@inlined
def _clamp(value: float, upper: float) -> float:
    """Limit a value to 0…`upper`; `min` and `max` check for NaN, which prevents vectorisation."""
    if value < 0.0:
        return 0.0
    if value > upper:
        return upper
    return value
