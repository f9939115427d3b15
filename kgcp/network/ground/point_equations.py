"""Observation equations of the points in one frame: compiled loops over a few points.

numpy takes longer to call than to compute for so few. Each point has three observations: its place
[px] and the logarithm of its distance.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray

_NO_DISTANCE_SD = 1e6  # standard deviation of the logarithm of a distance that is not measured
_LARGEST = float(np.finfo(np.float64).max)


@compiled
def fill_in_residuals(
    points: FloatArray,
    focal_scale: float,
    computed_px: FloatArray,
    pixels: FloatArray,
    distances_m: FloatArray,
    residuals: FloatArray,
) -> None:
    """Fill in observed minus computed places and logarithms of distances (n, 3).

    NaN: points behind the camera have no place, and some distances are not measured.

    Parameters
    ----------
    points : (n, 3) array
        In the camera frame [m].
    """
    for i in range(len(points)):
        x, y, z = points[i]
        for axis in range(2):
            off_px = pixels[i, axis] - computed_px[i, axis]
            residuals[i, axis] = off_px if z > 0.0 else np.nan
        distance_m = math.sqrt(x * x + y * y + z * z)
        residuals[i, 2] = np.log(distances_m[i] * focal_scale / distance_m)


@compiled
def fill_in_derivatives(
    points: FloatArray,
    normalised: FloatArray,
    lens: FloatArray,
    arms: FloatArray,
    world_from_camera: FloatArray,
    focal_scale: float,
    design: FloatArray,
    by_point: FloatArray,
) -> None:
    """Fill in the derivatives (n, 3, 7) by the pose's step and (n, 3, 3) by the positions.

    Parameters
    ----------
    points : (n, 3) array
        In the camera frame [m].
    normalised : (n, 2) array
        Their images, times the focal scale.
    lens : (n, 2, 2) array
        Derivatives of the pixels by them.
    arms : (n, 3) array
        From the projection centre to the points, in the world [m].
    """
    by_camera_point = np.empty((3, 3))
    for i in range(len(points)):
        x, y, z = points[i]
        square = x * x + y * y + z * z
        by_camera_point[2, 0], by_camera_point[2, 1] = x / square, y / square
        by_camera_point[2, 2] = z / square
        design[i, 2, 6] = -1.0
        for row in range(2):
            along = lens[i, row, 0] * normalised[i, 0] + lens[i, row, 1] * normalised[i, 1]
            by_camera_point[row, 0] = lens[i, row, 0] * (focal_scale / z)
            by_camera_point[row, 1] = lens[i, row, 1] * (focal_scale / z)
            by_camera_point[row, 2] = -along / z
            design[i, row, 6] = along
        arm_x, arm_y, arm_z = arms[i]
        for row in range(3):
            for axis in range(3):
                slope = 0.0
                for k in range(3):
                    slope += by_camera_point[row, k] * world_from_camera[axis, k]
                by_point[i, row, axis] = slope
                design[i, row, axis] = -slope
            by_x, by_y, by_z = by_point[i, row]
            # with R' = exp(ω) R a point moves by (X − C) × ω in the world's axes
            design[i, row, 3] = by_y * arm_z - by_z * arm_y
            design[i, row, 4] = by_z * arm_x - by_x * arm_z
            design[i, row, 5] = by_x * arm_y - by_y * arm_x


@compiled
def fill_in_covariances(
    by_point: FloatArray,
    position_cov: FloatArray,
    pixel_cov: FloatArray,
    distances_m: FloatArray,
    sd_distances_m: FloatArray,
    cov: FloatArray,
) -> None:
    """Fill in the covariances (n, 3, 3) of the observations, including those of the positions."""
    for i in range(len(by_point)):
        _carry(by_point[i], position_cov[i], cov[i])
        for row in range(2):
            for column in range(2):
                cov[i, row, column] += pixel_cov[i, row, column]
        if math.isfinite(distances_m[i]):
            cov[i, 2, 2] += (sd_distances_m[i] / distances_m[i]) ** 2
        else:
            for k in range(2):
                cov[i, 2, k] = cov[i, k, 2] = 0.0
            cov[i, 2, 2] = _NO_DISTANCE_SD**2


@compiled
def _carry(slopes: FloatArray, cov: FloatArray, carried: FloatArray) -> None:
    """Fill in A C Aᵀ (3, 3) for slopes A and a covariance C."""
    for row in range(3):
        for column in range(3):
            total = 0.0
            for axis in range(3):
                along = 0.0
                for k in range(3):
                    along += slopes[row, k] * cov[k, axis]
                total += along * slopes[column, axis]
            carried[row, column] = total


@compiled
def fill_in_squares(residuals: FloatArray, cov: FloatArray, squares: FloatArray) -> bool:
    """Fill in the χ² (n,) of residuals (n, 3); infinite where there is no place.

    A distance that is not measured counts as zero. Return whether all covariances (n, 3, 3) can be
    inverted.
    """
    whole = True
    row = np.empty((3, 1))
    for i in range(len(residuals)):
        is_regular, first, second, third = _factors(cov[i])
        whole &= is_regular
        for k in range(3):
            row[k, 0] = _finite(residuals[i, k])
        _subtract_carried(cov[i], first, second, row)
        squares[i] = np.inf
        if math.isfinite(residuals[i, 0]):
            total = row[0, 0] * row[0, 0] / first + row[1, 0] * row[1, 0] / second
            squares[i] = total + row[2, 0] * row[2, 0] / third
    return whole


@compiled
def add_products(
    unknowns: int,
    design: FloatArray,
    residuals: FloatArray,
    common: FloatArray,
    cov: FloatArray,
    weights: FloatArray,
    square: FloatArray,
) -> bool:
    """Add weighted products of the equations' columns to a matrix (p, p).

    Columns are the pose's first unknowns in `design` (n, 3, 7), the residuals (n, 3), of which NaN
    counts as zero, and the common errors in `common` (n, 3, k). Return whether all covariances
    (n, 3, 3) can be inverted.
    """
    count = len(square)
    rows = np.empty((3, count))
    whole = True
    for i in range(len(residuals)):
        is_regular, first, second, third = _factors(cov[i])
        whole &= is_regular
        diagonal = (first, second, third)
        for k in range(3):
            rows[k, :unknowns] = design[i, k, :unknowns]
            rows[k, unknowns] = _finite(residuals[i, k])
            rows[k, unknowns + 1 :] = common[i, k]
        _subtract_carried(cov[i], first, second, rows)
        for k in range(3):
            share = weights[i] / diagonal[k]
            for p in range(count):
                scaled = share * rows[k, p]
                for q in range(p + 1):
                    square[p, q] += scaled * rows[k, q]
    for p in range(count):
        for q in range(p):
            square[q, p] = square[p, q]
    return whole


@compiled
def _factors(cov: FloatArray) -> tuple[bool, float, float, float]:
    """Return the diagonal of D where cov = L D Lᵀ (3, 3), and whether it has no zero."""
    first = cov[0, 0]
    second = cov[1, 1] - cov[1, 0] * cov[1, 0] / first
    across = cov[2, 1] - cov[2, 0] * cov[1, 0] / first
    third = cov[2, 2] - cov[2, 0] * cov[2, 0] / first - across * across / second
    return first != 0.0 and second != 0.0 and third != 0.0, first, second, third


@compiled
def _subtract_carried(cov: FloatArray, first: float, second: float, rows: FloatArray) -> None:
    """Replace rows (3, p) by L⁻¹ times them, where cov = L D Lᵀ and D begins as given."""
    lower, lowest = cov[1, 0] / first, cov[2, 0] / first
    across = (cov[2, 1] - lowest * cov[1, 0]) / second
    for p in range(rows.shape[1]):
        rows[1, p] -= lower * rows[0, p]
        rows[2, p] -= lowest * rows[0, p] + across * rows[1, p]


@compiled
def _finite(value: float) -> float:
    """Return 0 for NaN, and the largest number for infinity, as `numpy.nan_to_num`."""
    if math.isnan(value):
        return 0.0
    return min(max(value, -_LARGEST), _LARGEST)
