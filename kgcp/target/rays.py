"""Outer edges of dark rings, followed along rays: one closed curve of few harmonics for each."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray

RAYS = 40
RAYS_RAD = 2.0 * np.pi / RAYS * np.arange(RAYS)
_RADII = np.arange(0.5, 1.71, 0.04)  # of the seed's radius
_STEP = 2  # samples either side that a slope is taken over
_EVERY = 2  # ray that is looked at first
_MIDDLES = _RADII[_STEP:-_STEP]
_SPACING = _RADII[1] - _RADII[0]
# ρ(θ) of an ellipse that is not far from a circle, nor its centre from the seed's.
_HARMONICS = np.stack(
    [np.ones(RAYS), *(f(k * RAYS_RAD) for k in (1, 2) for f in (np.cos, np.sin))], axis=1
)
_TERMS = _HARMONICS.shape[1]
_WIDTHS_AT_FIRST = np.array((0.25, 0.12, 0.07))  # of residuals' weighting, of the seed's radius
_WIDTHS = np.array((0.07, 0.05))
_REACH = 0.17  # of an edge from a curve, of the seed's radius
_INLIER = 0.07
_MIN_INLIERS, _MIN_INLIERS_AT_FIRST = 0.55, 0.6
_RIDGE = 1e-3  # keeps the curve through few edges near the mean circle

BoolArray = npt.NDArray[np.bool_]


@compiled
def follow(
    image: GreyArray,
    centres: FloatArray,
    radii: FloatArray,
    edges: FloatArray,
    inlying: BoolArray,
) -> None:
    """Look for the outer edges of rings: the steepest rises to brighter that lie on a curve.

    Parameters
    ----------
    image : (height, width) array of uint8
    centres : (n, 2) array
        Of the rings, roughly [px].
    radii : (n,) array
        Of the rings, roughly [px].
    edges : (n, rays) array
        Filled in: how far the edge is from the centre, of the radius.
    inlying : (n, rays) array of bool
        Filled in: which edges are on the curve; none at all if they are too few for a ring.
    """
    values = np.empty(len(_RADII))
    strength, scratch, curve = np.empty(RAYS), np.empty(RAYS), np.empty(_TERMS)
    for i in range(len(radii)):
        x, y, radius = centres[i, 0], centres[i, 1], radii[i]
        edge, is_inlying = edges[i], inlying[i]
        is_inlying[:] = False
        _glance(image, x, y, radius, values, edge, strength)
        _fit_curve(edge, strength, _EVERY, _WIDTHS_AT_FIRST, scratch, curve)
        near = _mark_near(edge, curve, 2.0 * _INLIER, _EVERY, is_inlying)
        if near > _MIN_INLIERS_AT_FIRST * (RAYS // _EVERY):
            _follow_curve(image, x, y, radius, curve, values, edge, strength)
            _fit_curve(edge, strength, 1, _WIDTHS, scratch, curve)
            _mark_near(edge, curve, _INLIER, 1, is_inlying)
            is_inlying &= strength > 0.0
        if is_inlying.sum() < _MIN_INLIERS * RAYS:
            is_inlying[:] = False


@compiled
def _glance(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    values: FloatArray,
    edge: FloatArray,
    strength: FloatArray,
) -> None:
    """Find the steepest rise outwards on some of the rays, in the pixels as they are."""
    last_x, last_y = image.shape[1] - 1, image.shape[0] - 1
    for k in range(0, RAYS, _EVERY):
        dx, dy = radius * _HARMONICS[k, 1], radius * _HARMONICS[k, 2]
        for j in range(len(_RADII)):
            column = min(max(int(x + _RADII[j] * dx + 0.5), 0), last_x)
            row = min(max(int(y + _RADII[j] * dy + 0.5), 0), last_y)
            values[j] = image[row, column]
        best, steepest = 0, -1.0
        for j in range(len(_MIDDLES)):
            slope = values[j + 2 * _STEP] - values[j]
            if slope > steepest:
                best, steepest = j, slope
        edge[k], strength[k] = _MIDDLES[best], max(steepest, 0.0)


@compiled
def _follow_curve(
    image: GreyArray,
    x: float,
    y: float,
    radius: float,
    curve: FloatArray,
    values: FloatArray,
    edge: FloatArray,
    strength: FloatArray,
) -> None:
    """Find the steepest rise outwards within reach of a curve on all rays, interpolated."""
    for k in range(RAYS):
        rho = _at(curve, k)
        first = max(math.ceil((rho - _REACH - _MIDDLES[0]) / _SPACING), 1)
        last = min(math.floor((rho + _REACH - _MIDDLES[0]) / _SPACING), len(_MIDDLES) - 2)
        edge[k], strength[k] = rho, 0.0
        if first > last:
            continue
        dx, dy = radius * _HARMONICS[k, 1], radius * _HARMONICS[k, 2]
        for j in range(first - 1, last + 2 + 2 * _STEP):
            values[j] = _bilinear(image, x + _RADII[j] * dx, y + _RADII[j] * dy)
        best = first
        for j in range(first, last + 1):
            if values[j + 2 * _STEP] - values[j] > values[best + 2 * _STEP] - values[best]:
                best = j
        left = values[best - 1 + 2 * _STEP] - values[best - 1]
        top = values[best + 2 * _STEP] - values[best]
        right = values[best + 1 + 2 * _STEP] - values[best + 1]
        bend = min(left - 2.0 * top + right, -1e-3)
        edge[k] = _MIDDLES[best] + _SPACING * min(max(0.5 * (left - right) / bend, -0.5), 0.5)
        strength[k] = max(top, 0.0)


@compiled
def _bilinear(image: GreyArray, x: float, y: float) -> float:
    """Return a grey value between pixels; beyond its border the image repeats its last pixels."""
    last_x, last_y = image.shape[1] - 1, image.shape[0] - 1
    column, row = min(max(x, 0.0), float(last_x)), min(max(y, 0.0), float(last_y))
    left, top = int(column), int(row)
    right, bottom = min(left + 1, last_x), min(top + 1, last_y)
    one, two = float(image[top, left]), float(image[top, right])
    three, four = float(image[bottom, left]), float(image[bottom, right])
    upper = one + (column - left) * (two - one)
    return upper + (row - top) * (three + (column - left) * (four - three) - upper)


@compiled
def _fit_curve(
    edge: FloatArray,
    strength: FloatArray,
    every: int,
    widths: FloatArray,
    scratch: FloatArray,
    curve: FloatArray,
) -> None:
    """Fit the harmonics of a curve, robustly: strong edges near it count most."""
    typical = _median(strength[::every], scratch) + 1e-6
    curve[0] = _median(edge[::every], scratch)
    curve[1:] = 0.0
    normal, right = np.empty((_TERMS, _TERMS)), np.empty(_TERMS)
    for width in widths:
        normal[:] = 0.0
        right[:] = 0.0
        for k in range(0, RAYS, every):
            residual = (edge[k] - _at(curve, k)) / width
            weight = min(strength[k] / typical, 1.0) / (1.0 + residual * residual) ** 2
            for i in range(_TERMS):
                weighted = weight * _HARMONICS[k, i]
                right[i] += weighted * edge[k]
                for j in range(i + 1):
                    normal[i, j] += weighted * _HARMONICS[k, j]
        for i in range(_TERMS):
            normal[i, i] += _RIDGE
        _solve(normal, right, curve)


@compiled
def _solve(lower: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """Solve positive definite equations, of which the lower triangle is given, by Cholesky."""
    for i in range(_TERMS):
        for j in range(i + 1):
            value = lower[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(value) if i == j else value / lower[j, j]
    for i in range(_TERMS):
        value = right[i]
        for k in range(i):
            value -= lower[i, k] * out[k]
        out[i] = value / lower[i, i]
    for i in range(_TERMS - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, _TERMS):
            value -= lower[k, i] * out[k]
        out[i] = value / lower[i, i]


@compiled
def _at(curve: FloatArray, ray: int) -> float:
    value = 0.0
    for i in range(_TERMS):
        value += curve[i] * _HARMONICS[ray, i]
    return value


@compiled
def _mark_near(
    edge: FloatArray, curve: FloatArray, reach: float, every: int, near: BoolArray
) -> int:
    """Tell which edges are within reach of a curve; return how many."""
    count = 0
    for k in range(0, RAYS, every):
        near[k] = abs(edge[k] - _at(curve, k)) < reach
        count += near[k]
    return count


@compiled
def _median(values: FloatArray, scratch: FloatArray) -> float:
    """Return the median of an even number of values, sorting a few of them by insertion."""
    for i in range(len(values)):
        value, k = values[i], i
        while k > 0 and scratch[k - 1] > value:
            scratch[k] = scratch[k - 1]
            k -= 1
        scratch[k] = value
    half = len(values) // 2
    return float(0.5 * (scratch[half - 1] + scratch[half]))
