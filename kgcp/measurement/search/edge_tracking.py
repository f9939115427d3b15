"""Outer edges of dark rings, tracked along rays: one closed curve of few harmonics for each.

An outer edge is where the grey values rise most on the way out of the ring. On a single ray that
may be the rim of a dot, a shadow or clutter. Over all rays, the edge of one ring is a smooth curve
about its centre: an ellipse whose centre is a little off the seed's, and whose axes differ a
little, has to first order the distances

    ρ(θ) = c₀ + c₁ cos θ + c₂ sin θ + c₃ cos 2θ + c₄ sin 2θ

so that a robust linear fit of five numbers tells the edge from the others. docs/method.md, "Edge
tracking", derives it; `fit_ellipses` puts the exact ellipse through what is left.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray

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
_FINEST_RADIUS_PX = 12.0  # of rings in the image that they are tracked in, or twice that
_RIDGE = 1e-3  # keeps the curve through few edges near the mean circle

RAYS_RAD = 2.0 * np.pi / RAYS * np.arange(RAYS)
_FEW = RAYS // _EVERY
_MIDDLES = _RADII[_STEP:-_STEP]
_SPACING = _RADII[1] - _RADII[0]
_HARMONICS = np.stack([np.ones(RAYS), *(f(k * RAYS_RAD) for k in (1, 2) for f in (np.cos, np.sin))])
_TERMS = len(_HARMONICS)
# What the normal equations add up for each ray: the lower triangle of products of harmonics, row
# by row, and then the harmonics themselves for the right-hand side.
_PAIRS = _TERMS * (_TERMS + 1) // 2
_PRODUCTS = np.stack([_HARMONICS[i] * _HARMONICS[j] for i in range(_TERMS) for j in range(i + 1)])
_SUMMANDS = np.ascontiguousarray(np.concatenate((_PRODUCTS, _HARMONICS)).T)
_FEW_HARMONICS = np.ascontiguousarray(_HARMONICS[:, ::_EVERY])
_FEW_SUMMANDS = np.ascontiguousarray(_SUMMANDS[::_EVERY])


@compiled
def track_edges(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    centres: FloatArray,
    radii: FloatArray,
    edges: FloatArray,
    inlying: BoolArray,
) -> None:
    """Look for the outer edges of rings: the steepest rises to brighter that lie on a curve.

    Each is tracked in the image in which its radius is 12 to 24 px: there a sample's spacing is
    half a pixel to one, and reduction has averaged the noise.

    Parameters
    ----------
    frame, reduced, levels
        Of a pyramid.
    centres, radii : (n, 2) and (n,) array
        Of the rings in the frame, roughly [px].
    edges : (n, rays) array
        Filled in: how far the edge is from the centre, of the radius.
    inlying : (n, rays) array of bool
        Filled in: which edges are on the curve; none at all if they are too few for a ring.
    """
    for i in range(len(radii)):
        octave, factor = 0, 1.0
        while 2 * octave < len(levels) and radii[i] >= 2.0 * factor * _FINEST_RADIUS_PX:
            octave, factor = octave + 1, 2.0 * factor
        x, y = (centres[i, 0] + 0.5) / factor - 0.5, (centres[i, 1] + 0.5) / factor - 0.5
        radius, edge, is_inlying = radii[i] / factor, edges[i], inlying[i]
        if octave == 0:  # apart, since the frame may be a read-only array: another type
            _track_ring(frame, x, y, radius, edge, is_inlying)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            _track_ring(image, x, y, radius, edge, is_inlying)


@compiled
def _track_ring(
    image: GreyArray, x: float, y: float, radius: float, edge: FloatArray, is_inlying: BoolArray
) -> None:
    """Fill in the edge of one ring about a pixel, and which parts of it are on the curve."""
    rough_edge, strength, residuals = np.empty(_FEW), np.empty(RAYS), np.empty(RAYS)
    curve = np.empty(_TERMS)
    is_inlying[:] = False
    _find_rough_edge(image, x, y, radius, rough_edge, strength)
    _fit_curve(
        rough_edge, strength, _FEW_HARMONICS, _FEW_SUMMANDS, _WIDTHS_AT_FIRST, residuals, curve
    )
    if np.sum(np.abs(residuals[:_FEW]) < 2.0 * _INLIER) <= _MIN_INLIERS_AT_FIRST * _FEW:
        return
    _find_edge_near(image, x, y, radius, curve, edge, strength)
    _fit_curve(edge, strength, _HARMONICS, _SUMMANDS, _WIDTHS, residuals, curve)
    is_inlying[:] = (np.abs(residuals) < _INLIER) & (strength > 0.0)
    is_inlying &= is_inlying.sum() >= _MIN_INLIERS * RAYS


@compiled
def _find_rough_edge(
    image: GreyArray, x: float, y: float, radius: float, edge: FloatArray, strength: FloatArray
) -> None:
    """Find the steepest rise outwards on some of the rays, in the pixels as they are.

    Addresses first, then grey values: only the second of the two loops cannot be vectorised.
    """
    pixels, width = image.reshape(-1), image.shape[1]
    last_x, last_y = width - 1, image.shape[0] - 1
    places, values = np.empty(len(_RADII), np.intp), np.empty(len(_RADII))
    for k in range(_FEW):
        dx, dy = radius * _FEW_HARMONICS[1, k], radius * _FEW_HARMONICS[2, k]
        for j in range(len(_RADII)):
            column = min(max(int(x + _RADII[j] * dx + 0.5), 0), last_x)
            row = min(max(int(y + _RADII[j] * dy + 0.5), 0), last_y)
            places[j] = row * width + column
        for j in range(len(_RADII)):
            values[j] = pixels[np.uintp(places[j])]
        best, steepest = 0, -1.0
        for j in range(len(_MIDDLES)):
            slope = values[j + 2 * _STEP] - values[j]
            if slope > steepest:
                best, steepest = j, slope
        edge[k], strength[k] = _MIDDLES[best], max(steepest, 0.0)


@compiled
def _find_edge_near(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    curve: FloatArray,
    edge: FloatArray,
    strength: FloatArray,
) -> None:
    """Find the steepest rise outwards within reach of a curve on all rays, between samples.

    Three slopes around the steepest give a parabola, whose maximum is the edge.
    """
    places, parts = np.empty(len(_RADII), np.intp), np.empty((2, len(_RADII)))
    values = np.empty(len(_RADII))
    for k in range(RAYS):
        rho = 0.0
        for i in range(_TERMS):
            rho += curve[i] * _HARMONICS[i, k]
        first = max(math.ceil((rho - _REACH - _MIDDLES[0]) / _SPACING), 1)
        last = min(math.floor((rho + _REACH - _MIDDLES[0]) / _SPACING), len(_MIDDLES) - 2)
        edge[k], strength[k] = rho, 0.0
        if first > last:
            continue
        radii = _RADII[first - 1 : last + 2 + 2 * _STEP]
        dx, dy = radius * _HARMONICS[1, k], radius * _HARMONICS[2, k]
        _sample_ray(image, x, y, dx, dy, radii, places, parts, values)
        best, top = 1, values[1 + 2 * _STEP] - values[1]
        for j in range(2, last - first + 2):
            slope = values[j + 2 * _STEP] - values[j]
            best, top = (j, slope) if slope > top else (best, top)
        left = values[best - 1 + 2 * _STEP] - values[best - 1]
        right = values[best + 1 + 2 * _STEP] - values[best + 1]
        bend = min(left - 2.0 * top + right, -1e-3)
        beside = min(max(0.5 * (left - right) / bend, -0.5), 0.5)
        edge[k] = _MIDDLES[first - 1 + best] + _SPACING * beside
        strength[k] = max(top, 0.0)


@compiled
def _sample_ray(
    image: GreyArray,
    x: float,
    y: float,
    dx: float,
    dy: float,
    radii: FloatArray,
    places: IndexArray,
    parts: FloatArray,
    values: FloatArray,
) -> None:
    """Fill in bilinear grey values along a ray; beyond the border the last pixels repeat.

    `places` and `parts` keep the pixels above and left of the samples, and how far these are beyond
    them: a loop of arithmetic alone is vectorised, one that also reads the image is not.
    """
    height, width = image.shape
    last_x, last_y = width - 1, height - 1
    for j in range(len(radii)):
        column = _clamp(x + radii[j] * dx, float(last_x))
        row = _clamp(y + radii[j] * dy, float(last_y))
        left, top = min(int(column), last_x - 1), min(int(row), last_y - 1)
        places[j] = top * width + left
        parts[0, j], parts[1, j] = column - left, row - top
    pixels = image.reshape(-1)
    for j in range(len(radii)):
        above = np.uintp(places[j])
        below = above + np.uintp(width)
        upper_left, upper_right = float(pixels[above]), float(pixels[above + np.uintp(1)])
        lower_left, lower_right = float(pixels[below]), float(pixels[below + np.uintp(1)])
        upper = upper_left + parts[0, j] * (upper_right - upper_left)
        lower = lower_left + parts[0, j] * (lower_right - lower_left)
        values[j] = upper + parts[1, j] * (lower - upper)


@inlined
def _clamp(value: float, most: float) -> float:
    """Return a value in 0…`most`; `min` and `max` check for NaN, which keeps loops from vectors."""
    if value < 0.0:
        return 0.0
    if value > most:
        return most
    return value


@compiled
def _fit_curve(
    edge: FloatArray,
    strength: FloatArray,
    harmonics: FloatArray,
    summands: FloatArray,
    widths: FloatArray,
    residuals: FloatArray,
    curve: FloatArray,
) -> None:
    """Fit the harmonics of a curve to edges on rays; strong edges near it count most.

    Least squares, reweighted with min(strength / median, 1) / (1 + (residual / width)²)² for each
    of the widths (Geman and McClure's function). They become narrower, so that the first curves are
    drawn by all edges, and the last by those of the ring alone.
    """
    strong, weight, sums = np.empty_like(edge), np.empty_like(edge), np.empty(_PAIRS + _TERMS)
    lower, typical = np.empty((_TERMS, _TERMS)), _median(strength[: len(edge)]) + 1e-6
    for k in range(len(edge)):
        strong[k] = _clamp(strength[k] / typical, 1.0)
    curve[0] = _median(edge)
    curve[1:] = 0.0
    _subtract(edge, harmonics, curve, residuals)
    for width in widths:
        for k in range(len(edge)):
            far = residuals[k] / width
            near = 1.0 / (1.0 + far * far)
            weight[k] = strong[k] * near * near
        _add_up(weight, edge, summands, sums)
        _solve(sums, lower, curve)
        _subtract(edge, harmonics, curve, residuals)


@compiled
def _subtract(
    edge: FloatArray, harmonics: FloatArray, curve: FloatArray, residuals: FloatArray
) -> None:
    """Fill in how far edges are from a curve."""
    a, b, c, d, e = curve[0], curve[1], curve[2], curve[3], curve[4]
    for k in range(len(edge)):
        first_order = a + b * harmonics[1, k] + c * harmonics[2, k]
        residuals[k] = edge[k] - first_order - d * harmonics[3, k] - e * harmonics[4, k]


@compiled
def _add_up(weight: FloatArray, edge: FloatArray, summands: FloatArray, sums: FloatArray) -> None:
    """Fill in the normal equations: the lower triangle row by row, then the right-hand side."""
    sums[:] = 0.0
    for k in range(len(edge)):
        weighted = weight[k] * edge[k]
        for i in range(_PAIRS):
            sums[i] += weight[k] * summands[k, i]
        for i in range(_PAIRS, _PAIRS + _TERMS):
            sums[i] += weighted * summands[k, i]


@compiled
def _solve(sums: FloatArray, lower: FloatArray, out: FloatArray) -> None:
    """Solve positive definite equations by Cholesky's decomposition, with reciprocal diagonal.

    By hand because a call of LAPACK for five unknowns costs several times as much.
    """
    place = 0
    for i in range(_TERMS):
        for j in range(i + 1):
            value = sums[place] + (_RIDGE if i == j else 0.0)
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = 1.0 / math.sqrt(value) if i == j else value * lower[j, j]
            place += 1
    for i in range(_TERMS):
        value = sums[_PAIRS + i]
        for k in range(i):
            value -= lower[i, k] * out[k]
        out[i] = value * lower[i, i]
    for i in range(_TERMS - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, _TERMS):
            value -= lower[k, i] * out[k]
        out[i] = value * lower[i, i]


@compiled
def _median(values: FloatArray) -> float:
    """Return the median of an even number of values, counting how many are less than each.

    For so few, n² comparisons in vector units are faster than sorting.
    """
    below, above = -np.inf, -np.inf
    for i in range(len(values)):
        less = 0
        for k in range(len(values)):
            less += values[k] < values[i]
        below = max(below, values[i]) if 2 * less < len(values) else below
        above = max(above, values[i]) if 2 * less <= len(values) else above
    return 0.5 * (below + above)
