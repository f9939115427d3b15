"""Robust fits of closed curves with few harmonics to edges on rays, for many curves at once.

To first order, an ellipse has these distances from a point near its centre:

    ρ(θ) = c₀ + c₁ cos θ + c₂ sin θ + c₃ cos 2θ + c₄ sin 2θ

Products of these functions are sums of cosines and sines up to 4θ: cos θ · cos 2θ is half of cos θ
+ cos 3θ, and so on. So the normal matrix follows from nine weighted sums instead of fifteen.

The steps of a single fit depend on each other, so that the processor would mostly wait. Therefore
many curves are fitted side by side: each step is a loop over curves, which is vectorised.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, GreyArray

TERMS = 5
"""Number of a curve's parameters: the constant, cosine and sine of θ, cosine and sine of 2θ."""

_SUMS = 9  # weighted sums of 1 and of cosine and sine of θ to 4θ
_IS_ODD = np.array((0, 1, 1, 0, 0, 1, 1, 0, 0))  # whether the order of each function is odd
_BATCH = 64  # curves that are fitted together; their sums stay in the processor's cache
_RIDGE = 1e-3  # keeps the curve close to a circle if there are few edges


def waves_of(rays: int) -> FloatArray:
    """Return (9, rays / 2): 1, cosine and sine of θ to 4θ on the first half of equidistant rays."""
    orders = np.arange(1, 5)[:, None] * (2.0 * np.pi / rays * np.arange(rays // 2))
    waves = np.stack((np.cos(orders), np.sin(orders)), axis=1).reshape(8, -1)
    return np.concatenate((np.ones((1, rays // 2)), waves))


@compiled
def fit_curves(
    edges: FloatArray,
    strengths: GreyArray,
    waves: FloatArray,
    widths: FloatArray,
    curves: FloatArray,
    residuals: FloatArray,
) -> None:
    """Fit curves to edges on rays, by iteratively reweighted least squares.

    The weights are min(strength / median, 1) / (1 + (residual / width)²)² (Geman and McClure's
    function). There is one pass for each width. The widths decrease, so that all edges determine
    the first curves, and only those of the ring the last ones.

    Parameters
    ----------
    edges : (rays, n) array
        Distances of the edges. The rays are equidistant in angle, and their number is even.
    strengths : (rays, n) array of uint8
        Slopes of the edges.
    waves : (9, rays / 2) array
        Result of `waves_of`.
    widths : (passes,) array
        In the unit of the distances.
    curves : (5, n) array
        Initial parameters; replaced by the result.
    residuals : (rays, n) array
        Filled in: distances of the edges minus those of the curves.
    """
    rays, count = edges.shape
    typical, strong = np.empty(_BATCH), np.empty((rays, _BATCH))
    sums, lower = np.empty((_SUMS + TERMS, _BATCH)), np.empty((TERMS, TERMS, _BATCH))
    for begin in range(0, count, _BATCH):
        end = min(begin + _BATCH, count)
        some, clear = edges[:, begin:end], strengths[:, begin:end]
        curve, residual = curves[:, begin:end], residuals[:, begin:end]
        fill_in_medians(clear, typical)
        for k in range(rays):
            for i in range(end - begin):
                strong[k, i] = _strength_weight(float(clear[k, i]), typical[i])
        _subtract(some, waves, curve, residual)
        for width in widths:
            _add_up(some, residual, strong, waves, width, sums)
            _decompose(sums, lower)
            _solve(sums, lower, curve)
            _subtract(some, waves, curve, residual)


@inlined
def _strength_weight(strength: float, typical: float) -> float:
    """Return min(strength / typical, 1); `min` checks for NaN, which prevents vectorisation."""
    if strength > typical:
        return 1.0
    return strength / (typical + 1e-6)


@compiled
def _subtract(
    edges: FloatArray, waves: FloatArray, curves: FloatArray, residuals: FloatArray
) -> None:
    """Fill in the residuals of edges from curves."""
    a, b, c, d, e = curves
    half = len(edges) // 2
    for k in range(half):
        cosine, sine, cosine_twice, sine_twice = waves[1, k], waves[2, k], waves[3, k], waves[4, k]
        edge, opposite = edges[k], edges[half + k]
        residual, residual_opposite = residuals[k], residuals[half + k]
        for i in range(len(a)):
            even = a[i] + d[i] * cosine_twice + e[i] * sine_twice
            odd = b[i] * cosine + c[i] * sine
            residual[i] = edge[i] - (even + odd)
            residual_opposite[i] = opposite[i] - (even - odd)


@compiled
def _add_up(
    edges: FloatArray,
    residuals: FloatArray,
    strong: FloatArray,
    waves: FloatArray,
    width: float,
    sums: FloatArray,
) -> None:
    """Fill in sums over the rays: of weights times nine waves, of weighted edges times five waves.

    Waves of even order are equal on opposite rays; those of odd order have opposite signs.
    """
    count, half = edges.shape[1], len(edges) // 2
    weights = np.empty((2, count))  # of two opposite rays; later multiplied by their edges
    parts = np.empty((2, count))  # their sum and difference
    sums[:] = 0.0
    for k in range(half):
        _weigh(residuals[k], strong[k], width, weights[0])
        _weigh(residuals[half + k], strong[half + k], width, weights[1])
        _add_and_subtract(weights, parts)
        for t in range(_SUMS):
            _add_product(sums[t], parts[_IS_ODD[t]], waves[t, k])
        _multiply(weights[0], edges[k])
        _multiply(weights[1], edges[half + k])
        _add_and_subtract(weights, parts)
        for t in range(TERMS):
            _add_product(sums[_SUMS + t], parts[_IS_ODD[t]], waves[t, k])


@inlined
def _weigh(residuals: FloatArray, most: FloatArray, width: float, weights: FloatArray) -> None:
    for i in range(len(weights)):
        far = residuals[i] / width
        near = 1.0 / (1.0 + far * far)
        weights[i] = most[i] * near * near


@inlined
def _add_and_subtract(pair: FloatArray, out: FloatArray) -> None:
    left, right, total, difference = pair[0], pair[1], out[0], out[1]
    for i in range(len(left)):
        total[i] = left[i] + right[i]
    for i in range(len(left)):
        difference[i] = left[i] - right[i]


@inlined
def _add_product(out: FloatArray, values: FloatArray, factor: float) -> None:
    for i in range(len(values)):
        out[i] += values[i] * factor


@compiled
def _decompose(sums: FloatArray, lower: FloatArray) -> None:
    """Fill in Cholesky factors of the normal matrices, with reciprocal diagonal elements.

    Written out because calling LAPACK for five unknowns takes several times as long.
    """
    constant, cosine, sine, cosine_2, sine_2, cosine_3, sine_3, cosine_4, sine_4 = sums[:_SUMS]
    for i in range(sums.shape[1]):
        lower[0, 0, i] = constant[i] + _RIDGE
        lower[1, 0, i], lower[2, 0, i] = cosine[i], sine[i]
        lower[3, 0, i], lower[4, 0, i] = cosine_2[i], sine_2[i]
        lower[1, 1, i] = 0.5 * (constant[i] + cosine_2[i]) + _RIDGE
        lower[2, 1, i] = 0.5 * sine_2[i]
        lower[2, 2, i] = 0.5 * (constant[i] - cosine_2[i]) + _RIDGE
        lower[3, 1, i] = 0.5 * (cosine[i] + cosine_3[i])
        lower[3, 2, i] = 0.5 * (sine_3[i] - sine[i])
        lower[4, 1, i] = 0.5 * (sine_3[i] + sine[i])
        lower[4, 2, i] = 0.5 * (cosine[i] - cosine_3[i])
        lower[3, 3, i] = 0.5 * (constant[i] + cosine_4[i]) + _RIDGE
        lower[4, 3, i] = 0.5 * sine_4[i]
        lower[4, 4, i] = 0.5 * (constant[i] - cosine_4[i]) + _RIDGE
    for a in range(TERMS):
        for b in range(a + 1):
            for c in range(b):
                _subtract_product(lower[a, b], lower[a, c], lower[b, c])
            entry, diagonal = lower[a, b], lower[b, b]
            for i in range(len(entry)):
                entry[i] = 1.0 / math.sqrt(entry[i]) if a == b else entry[i] * diagonal[i]


@compiled
def _solve(sums: FloatArray, lower: FloatArray, curves: FloatArray) -> None:
    """Solve the normal equations by forward and backward substitution."""
    for a in range(TERMS):
        unknown, right = curves[a], sums[_SUMS + a]
        for i in range(len(unknown)):
            unknown[i] = right[i]
        for b in range(a):
            _subtract_product(unknown, lower[a, b], curves[b])
        _multiply(unknown, lower[a, a])
    for a in range(TERMS - 1, -1, -1):
        for b in range(a + 1, TERMS):
            _subtract_product(curves[a], lower[b, a], curves[b])
        _multiply(curves[a], lower[a, a])


@inlined
def _subtract_product(out: FloatArray, left: FloatArray, right: FloatArray) -> None:
    for i in range(len(out)):
        out[i] -= left[i] * right[i]


@inlined
def _multiply(out: FloatArray, factor: FloatArray) -> None:
    for i in range(len(out)):
        out[i] *= factor[i]


@compiled
def fill_in_medians(values: GreyArray, medians: FloatArray) -> None:
    """Fill in the medians (n,) of values (rays, n) over the rays.

    For each value, the smaller ones are counted. For so few bytes, vectorised comparisons of all
    pairs are faster than sorting.
    """
    rays, count = values.shape
    most = np.uint8(rays // 2)
    less, below, above = (
        np.empty(count, np.uint8),
        np.zeros(count, np.uint8),
        np.zeros(count, np.uint8),
    )
    for k in range(rays):
        value = values[k]
        less[:] = 0
        for j in range(rays):
            other = values[j]
            for i in range(count):
                less[i] += np.uint8(other[i] < value[i])
        for i in range(count):
            below[i] = max(below[i], value[i] if less[i] < most else np.uint8(0))
        for i in range(count):
            above[i] = max(above[i], value[i] if less[i] <= most else np.uint8(0))
    for i in range(count):
        medians[i] = 0.5 * (np.float64(below[i]) + np.float64(above[i]))
