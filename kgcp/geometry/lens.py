"""Brown-Conrady distortion in OpenCV's order of coefficients, point by point; compiled."""

from __future__ import annotations

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray

_MAX_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-8  # convergence is quadratic: the step leaves its square

Lens = tuple[float, float, float, float, float, float, float, float]
"""k1, k2, p1, p2, k3, k4, k5, k6."""


@compiled
def _radial(lens: Lens, r2: float) -> tuple[float, float]:
    """Return the radial factor and its derivative with respect to r²."""
    k1, k2, _, _, k3, k4, k5, k6 = lens
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor = above / below
    slope_above = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    slope_below = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
    return factor, (slope_above - factor * slope_below) / below


@compiled
def _distorted(lens: Lens, x: float, y: float) -> tuple[float, float]:
    p1, p2 = lens[2], lens[3]
    r2 = x * x + y * y
    factor, _ = _radial(lens, r2)
    xy2 = 2.0 * x * y
    return (
        x * factor + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * factor + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
    )


@compiled
def _slopes(lens: Lens, x: float, y: float) -> tuple[float, float, float]:
    """Return the derivatives of the distorted x by x, of either by the other, and of y by y."""
    p1, p2 = lens[2], lens[3]
    factor, slope = _radial(lens, x * x + y * y)
    return (
        factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * (slope * x * y + p1 * x + p2 * y),
        factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled
def distort_points(lens: Lens, points: FloatArray, distorted: FloatArray) -> None:
    """Distort normalised points (n, 2)."""
    for i in range(points.shape[0]):
        distorted[i, 0], distorted[i, 1] = _distorted(lens, points[i, 0], points[i, 1])


@compiled
def distort_slopes(lens: Lens, points: FloatArray, slopes: FloatArray) -> None:
    """Fill in the derivatives (n, 2, 2) of `distort_points`: rows of results, columns of points."""
    for i in range(points.shape[0]):
        xx, xy, yy = _slopes(lens, points[i, 0], points[i, 1])
        slopes[i, 0, 0], slopes[i, 0, 1], slopes[i, 1, 0], slopes[i, 1, 1] = xx, xy, xy, yy


@compiled
def undistort_points(lens: Lens, distorted: FloatArray, points: FloatArray) -> None:
    """Invert `distort_points` by Newton's method, to 1e-13; NaN where it does not converge."""
    for i in range(points.shape[0]):
        x, y = wanted_x, wanted_y = distorted[i, 0], distorted[i, 1]
        is_found = False
        for _ in range(_MAX_NEWTON_STEPS):
            there_x, there_y = _distorted(lens, x, y)
            xx, xy, yy = _slopes(lens, x, y)
            off_x, off_y, determinant = there_x - wanted_x, there_y - wanted_y, xx * yy - xy * xy
            step_x = (yy * off_x - xy * off_y) / determinant
            step_y = (xx * off_y - xy * off_x) / determinant
            x, y = x - step_x, y - step_y
            if abs(step_x) <= _NEWTON_TOLERANCE and abs(step_y) <= _NEWTON_TOLERANCE:
                is_found = True
                break
        points[i, 0], points[i, 1] = (x, y) if is_found else (np.nan, np.nan)
