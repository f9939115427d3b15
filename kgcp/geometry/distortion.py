"""Brown-Conrady distortion in OpenCV's order of coefficients, and its inverse: compiled loops."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import numpy as np

from kgcp.geometry._jit import compiled_if_often, interpreted
from kgcp.geometry.arrays import FloatArray

# The "fold" is where the distorted radius stops growing with the undistorted one. Beyond it the
# mapping is not invertible.
_MAX_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-8  # of the last step; convergence is quadratic, so the error is its square
# Largest normalised radius that is considered, 76° off the axis. If a lens model folds, no ray
# beyond it is accepted.
_MAX_RADIUS = 4.0
_RADII = np.linspace(0.0, _MAX_RADIUS, 801)
_FOLD_STEPS = 128  # from the axis to a point, when testing whether the fold lies between

Lens = tuple[float, float, float, float, float, float, float, float]
"""k1, k2, p1, p2, k3, k4, k5, k6."""

Scale = tuple[float, float, float, float]
"""fx, fy, cx, cy [px]."""

_Real = TypeVar("_Real", float, FloatArray)  # one number, or one per point


@compiled_if_often
def _radial(lens: Lens, r2: _Real) -> tuple[_Real, _Real]:
    """Return the radial factor and its derivative with respect to r²."""
    k1, k2, _, _, k3, k4, k5, k6 = lens
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor = above / below
    slope_above = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    slope_below = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
    return factor, (slope_above - factor * slope_below) / below


_radial_of_many = interpreted(_radial)  # called once per camera: not worth compiling


@lru_cache
def first_fold_r2(lens: Lens) -> float:
    """Return the squared normalised radius at which the radial distortion folds, or infinity."""
    r2 = _RADII**2
    factor, slope = _radial_of_many(lens, r2)
    with np.errstate(all="ignore"):  # coefficients may be any finite numbers
        is_before = (factor > 0.0) & (factor + 2.0 * r2 * slope > 0.0)
    return np.inf if is_before.all() else float(r2[np.argmin(is_before)])


@compiled_if_often
def _distorted(lens: Lens, x: _Real, y: _Real) -> tuple[_Real, _Real]:
    p1, p2 = lens[2], lens[3]
    r2 = x * x + y * y
    factor, _ = _radial(lens, r2)
    xy2 = 2.0 * x * y
    return (
        x * factor + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * factor + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
    )


@compiled_if_often
def _jacobian(lens: Lens, x: float, y: float) -> tuple[float, float, float]:
    """Return the elements xx, xy = yx and yy of the distortion's Jacobian, which is symmetric."""
    p1, p2 = lens[2], lens[3]
    factor, slope = _radial(lens, x * x + y * y)
    return (
        factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * (slope * x * y + p1 * x + p2 * y),
        factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled_if_often
def _is_before_fold(lens: Lens, x: float, y: float) -> bool:
    """Tell whether the Jacobian's determinant is positive from the axis to a normalised point."""
    if x * x + y * y > _MAX_RADIUS * _MAX_RADIUS:
        return False
    for k in range(1, _FOLD_STEPS):
        xx, xy, yy = _jacobian(lens, x * k / _FOLD_STEPS, y * k / _FOLD_STEPS)
        if xx * yy - xy * xy <= 0.0:
            return False
    return True


@compiled_if_often
def distort_points(lens: Lens, scale: Scale, points: FloatArray, pixels: FloatArray) -> None:
    """Fill in the pixels (n, 2) of normalised points (n, 2), with array operations.

    So the interpreted version is one call for all points, too.
    """
    fx, fy, cx, cy = scale
    x, y = _distorted(lens, points[:, 0], points[:, 1])
    pixels[:, 0], pixels[:, 1] = fx * x + cx, fy * y + cy


@compiled_if_often
def distort_circles(
    lens: Lens,
    scale: Scale,
    axes: FloatArray,
    centre: FloatArray,
    radii: FloatArray,
    circle: FloatArray,
    pixels: FloatArray,
) -> None:
    """Fill in the pixels (m, k, 2) of concentric circles in space with radii (m,).

    Their centre is given in the camera frame, their plane by the first two columns of `axes`.
    `circle` (k, 2) are points of the unit circle.
    """
    fx, fy, cx, cy = scale
    for m in range(len(radii)):
        for k in range(len(circle)):
            u, v = radii[m] * circle[k, 0], radii[m] * circle[k, 1]
            inverse = 1.0 / (centre[2] + axes[2, 0] * u + axes[2, 1] * v)
            x = (centre[0] + axes[0, 0] * u + axes[0, 1] * v) * inverse
            y = (centre[1] + axes[1, 0] * u + axes[1, 1] * v) * inverse
            x, y = _distorted(lens, x, y)
            pixels[m, k, 0], pixels[m, k, 1] = fx * x + cx, fy * y + cy


@compiled_if_often
def fill_in_jacobians(lens: Lens, scale: Scale, points: FloatArray, jacobians: FloatArray) -> None:
    """Fill in the Jacobians (n, 2, 2) of `distort_points`: rows pixels, columns points."""
    fx, fy, _, _ = scale
    for i in range(points.shape[0]):
        xx, xy, yy = _jacobian(lens, points[i, 0], points[i, 1])
        jacobians[i, 0, 0], jacobians[i, 0, 1] = fx * xx, fx * xy
        jacobians[i, 1, 0], jacobians[i, 1, 1] = fy * xy, fy * yy


@compiled_if_often
def undistort_points(
    lens: Lens, scale: Scale, fold_r2: float, pixels: FloatArray, points: FloatArray
) -> None:
    """Invert `distort_points` by Newton's method, to 1e-13; NaN for pixels beyond the fold.

    For such pixels the method does not converge, or it converges to a point beyond one fold or two.
    One fold shows in the sign of the Jacobian. Two folds restore that sign, so that the path from
    the axis must be tested: only for points farther out than `fold_r2`.
    """
    fx, fy, cx, cy = scale
    for i in range(pixels.shape[0]):
        x = wanted_x = (pixels[i, 0] - cx) / fx
        y = wanted_y = (pixels[i, 1] - cy) / fy
        is_found = False
        for _ in range(_MAX_NEWTON_STEPS):
            at_x, at_y = _distorted(lens, x, y)
            xx, xy, yy = _jacobian(lens, x, y)
            off_x, off_y, determinant = at_x - wanted_x, at_y - wanted_y, xx * yy - xy * xy
            step_x = (yy * off_x - xy * off_y) / determinant
            step_y = (xx * off_y - xy * off_x) / determinant
            x, y = x - step_x, y - step_y
            if abs(step_x) <= _NEWTON_TOLERANCE and abs(step_y) <= _NEWTON_TOLERANCE:
                is_upright = determinant > 0.0 and xx + yy > 0.0
                is_found = is_upright and (x * x + y * y <= fold_r2 or _is_before_fold(lens, x, y))
                break
        points[i, 0], points[i, 1] = (x, y) if is_found else (np.nan, np.nan)
