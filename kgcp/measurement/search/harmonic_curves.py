"""Closed curves of few harmonics through edges on rays, robustly: many curves at once.

To first order, an ellipse about a point near its centre has the distances

    ρ(θ) = c₀ + c₁ cos θ + c₂ sin θ + c₃ cos 2θ + c₄ sin 2θ

Sums of weights times products of these functions are sums of weights times cosines and sines of up
to 4θ: cos θ · cos 2θ is half of cos θ + cos 3θ, and so on. So nine sums make the normal matrix, not
fifteen.

The operations of a single fit depend on each other, so that the processor mostly waits. Therefore
curves stand side by side in all arrays, and each step is one loop over many of them, of which the
processor takes several at once.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, GreyArray

TERMS = 5
"""Numbers of a curve: the constant, then cosine and sine of θ and of 2θ."""

_SUMS = 9  # of weights: with 1, then with cosine and sine of θ to 4θ
_IS_ODD = np.array((0, 1, 1, 0, 0, 1, 1, 0, 0))  # a wave's order
_TOGETHER = 64  # curves whose sums stay in the processor's cache
_RIDGE = 1e-3  # keeps the curve through few edges near the mean circle


def waves_of(rays: int) -> FloatArray:
    """Return what `fit_curves` needs of rays of equal angles: (9, rays / 2), 1 and eight waves."""
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
    """Fit curves to edges on rays; strong edges near its curve count most.

    Least squares, reweighted with min(strength / median, 1) / (1 + (residual / width)²)² for each
    of the widths (Geman and McClure's function). They become narrower, so that the first curves are
    drawn by all edges, and the last by those of the ring alone.

    Parameters
    ----------
    edges : (rays, n) array
        Distances. The rays have equal angles, and their number is even.
    strengths : (rays, n) array of uint8
        How clear they are.
    waves : (9, rays / 2) array
        By `waves_of`.
    widths : (passes,) array
        Of distances.
    curves : (5, n) array
        At first where the fit starts, then what it ends with.
    residuals : (rays, n) array
        Filled in: the edges' distances less the curves'.
    """
    rays, count = edges.shape
    typical, strong = np.empty(_TOGETHER), np.empty((rays, _TOGETHER))
    sums, lower = np.empty((_SUMS + TERMS, _TOGETHER)), np.empty((TERMS, TERMS, _TOGETHER))
    for begin in range(0, count, _TOGETHER):
        end = min(begin + _TOGETHER, count)
        some, clear = edges[:, begin:end], strengths[:, begin:end]
        curve, residual = curves[:, begin:end], residuals[:, begin:end]
        fill_in_medians(clear, typical)
        for k in range(rays):
            for i in range(end - begin):
                strong[k, i] = _share(float(clear[k, i]), typical[i])
        _subtract(some, waves, curve, residual)
        for width in widths:
            _add_up(some, residual, strong, waves, width, sums)
            _decompose(sums, lower)
            _solve(sums, lower, curve)
            _subtract(some, waves, curve, residual)


@inlined
def _share(strength: float, typical: float) -> float:
    """Return an edge's weight by its strength; `min` would check for NaN and prevent vectors."""
    if strength > typical:
        return 1.0
    return strength / (typical + 1e-6)


@compiled
def _subtract(
    edges: FloatArray, waves: FloatArray, curves: FloatArray, residuals: FloatArray
) -> None:
    """Fill in how far edges are from curves."""
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
    """Fill in sums over the rays: weights times nine waves, then weighted edges times five.

    Waves of an even order are the same on opposite rays, those of an odd one have other signs.
    """
    count, half = edges.shape[1], len(edges) // 2
    weights = np.empty((2, count))  # of opposite rays, then times their edges
    parts = np.empty((2, count))  # sum and difference of the two
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
    """Fill in Cholesky's triangles of the normal matrices, with reciprocal diagonals.

    By hand because a call of LAPACK for five unknowns costs several times as much.
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
    """Fill in what solves the normal equations, forwards and backwards through the triangles."""
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
    """Fill in medians (n,) over the rays, counting for each value (rays, n) how many are less.

    For so few bytes, n² comparisons in vector units are faster than sorting.
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
