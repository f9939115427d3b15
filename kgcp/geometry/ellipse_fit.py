"""Direct ellipse fits to edge points on rays: `kgcp.geometry.conic.fit_ellipse` for many rings."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray

_RIDGE = 1e-9  # keeps fits to too few points from being singular; they are rejected later


@compiled
def fit_ellipses(
    edges: FloatArray,
    inlying: BoolArray,
    directions: FloatArray,
    max_axis_ratio: float,
    ellipses: FloatArray,
    shares: FloatArray,
) -> None:
    """Fit an ellipse to the edge points of each ring (Fitzgibbon 1999; Halíř & Flusser 1998).

    Parameters
    ----------
    edges : (n, rays) array
        Distances of the edge points from the origin.
    inlying : (n, rays) array of bool
        Edge points that are fitted.
    directions : (rays, 2) array
        Unit vectors of the rays.
    max_axis_ratio : float
        Largest ratio of the axes that is accepted.
    ellipses : (n, 5) array
        Filled in: centre, semi-major and semi-minor axis, direction of the major one [rad].
    shares : (n,) array
        Filled in: share of the rays that are fitted; 0 if no ellipse fits or its axes differ too
        much.
    """
    powers = np.empty(5)
    moments = np.empty((5, 5))
    for i in range(len(edges)):
        shares[i] = inlying[i].mean()
        if shares[i] == 0.0:
            continue
        moments[:] = 0.0
        for k in range(len(directions)):
            if inlying[i, k]:
                x, y = edges[i, k] * directions[k, 0], edges[i, k] * directions[k, 1]
                powers[0] = 1.0
                for p in range(1, 5):
                    powers[p] = powers[p - 1] * y
                power = 1.0
                for p in range(5):
                    for q in range(5 - p):
                        moments[p, q] += power * powers[q]
                    power *= x
        if not (_fit(moments, ellipses[i]) and ellipses[i, 2] <= max_axis_ratio * ellipses[i, 3]):
            shares[i] = 0.0


@compiled
def _fit(moments: FloatArray, ellipse: FloatArray) -> bool:
    """Fit an ellipse to points given by their sums of xᵖ yᑫ; return False if none fits."""
    linear, inverse = np.empty((3, 3)), np.empty((3, 3))
    mixed, reduce, matrix = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    _fill(moments, linear, mixed)
    for i in range(3):
        _cross(linear[(i + 1) % 3], linear[(i + 2) % 3], inverse[i])
    determinant = _dot(linear[0], inverse[0])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                reduce[i, j] -= inverse[i, k] * mixed[k, j] / determinant
    for i in range(3):  # inverse matrix of the constraint 4 ac - b², times the reduced scatter
        row, factor = 2 - i, (0.5, -1.0, 0.5)[i]
        for j in range(3):
            value = moments[4 - row - j, row + j]
            for k in range(3):
                value += mixed[k, row] * reduce[k, j]
            matrix[i, j] = factor * value
    form, rest = np.empty(3), np.empty(3)
    _dominant_eigenvector(matrix, form)
    if 4.0 * form[0] * form[2] - form[1] * form[1] <= 0.0:
        return False
    for i in range(3):
        rest[i] = _dot(reduce[i], form)
    return _axes(form, rest, ellipse)


@compiled
def _fill(moments: FloatArray, linear: FloatArray, mixed: FloatArray) -> None:
    """Fill in the scatter matrices of x, y, 1 with themselves, and with x², xy, y²."""
    for i in range(3):
        p, q = (i == 0) * 1, (i == 1) * 1
        linear[i, 0], linear[i, 1], linear[i, 2] = (
            moments[p + 1, q],
            moments[p, q + 1],
            moments[p, q],
        )
        linear[i, i] += _RIDGE
        mixed[i, 0], mixed[i, 1], mixed[i, 2] = (
            moments[p + 2, q],
            moments[p + 1, q + 1],
            moments[p, q + 2],
        )


@compiled
def _dominant_eigenvector(matrix: FloatArray, vector: FloatArray) -> None:
    """Fill in an eigenvector (3,) of the largest of three real eigenvalues, in closed form.

    The constrained scatter matrix has a single non-negative eigenvalue, which belongs to the
    ellipse.
    """
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    minors = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    minors += matrix[0, 0] * matrix[2, 2] - matrix[0, 2] * matrix[2, 0]
    minors += matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1]
    trial = np.empty(3)
    _cross(matrix[0], matrix[1], trial)
    determinant = _dot(trial, matrix[2])
    spread = math.sqrt(max(trace * trace - 3.0 * minors, 0.0)) / 3.0
    skew = (2.0 * trace**3 - 9.0 * trace * minors + 27.0 * determinant) / 54.0
    cosine = min(max(skew / spread**3, -1.0), 1.0) if spread > 0.0 else 1.0
    largest = trace / 3.0 + 2.0 * spread * math.cos(math.acos(cosine) / 3.0)
    for i in range(3):
        matrix[i, i] -= largest
    longest = -1.0
    for i in range(3):
        _cross(matrix[i], matrix[(i + 1) % 3], trial)
        length = _dot(trial, trial)
        if length > longest:
            longest = length
            vector[:] = trial
    for i in range(3):
        vector[i] /= math.sqrt(max(longest, 1e-300))


@compiled
def _cross(one: FloatArray, two: FloatArray, out: FloatArray) -> None:
    out[0] = one[1] * two[2] - one[2] * two[1]
    out[1] = one[2] * two[0] - one[0] * two[2]
    out[2] = one[0] * two[1] - one[1] * two[0]


@compiled
def _dot(one: FloatArray, two: FloatArray) -> float:
    return float(one[0] * two[0] + one[1] * two[1] + one[2] * two[2])


@compiled
def _axes(form: FloatArray, rest: FloatArray, ellipse: FloatArray) -> bool:
    """Fill in centre, semi-axes and direction of a conic; return False if it is imaginary.

    `form` are its coefficients of x², xy and y², `rest` those of x, y and 1.
    """
    sign = 1.0 if form[0] + form[2] > 0.0 else -1.0
    a, b, c = sign * form[0], sign * form[1], sign * form[2]
    d, e, f = sign * rest[0], sign * rest[1], sign * rest[2]
    determinant = 4.0 * a * c - b * b
    x, y = (b * e - 2.0 * c * d) / determinant, (b * d - 2.0 * a * e) / determinant
    depth = -(f + 0.5 * (d * x + e * y))
    if depth <= 0.0:
        return False
    middle, half = 0.5 * (a + c), 0.5 * math.hypot(a - c, b)
    ellipse[0], ellipse[1] = x, y
    ellipse[2], ellipse[3] = math.sqrt(depth / (middle - half)), math.sqrt(depth / (middle + half))
    ellipse[4] = 0.5 * math.atan2(-b, c - a)  # direction of the smaller curvature
    return True
