"""The plate without blur: white share of every pixel, and its distance from the nearest edge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.plate import (
    ISOTROPIC,
    Circles,
    distances_and_group_ends,
    plate_points,
)


@dataclass(frozen=True, slots=True, eq=False)
class UnblurredPlate:
    """The plate under n pixels."""

    points_m: FloatArray  # (2, n): where the pixels' rays meet the plate
    rho_m: FloatArray  # (n,): distance of these points from the target's centre
    share: FloatArray  # (n,): white share: 0 for ink, 1 for plate
    # (n,): distance from the nearest edge; 0 inside small discs. Distances beyond the reach may be
    # too large.
    edge_distance_m: FloatArray
    # (n,): distance from the nearest edge of the measured circles, regardless of small discs. It is
    # scaled to the blur: larger if the blur across the edge is less than its upper bound.
    measured_edge_distance_m: FloatArray


def unblurred_plate(
    circles: Circles,
    measured_count: int,
    pose: Pose,
    rays: FloatArray,
    *,
    small_radius_m: float = 0.0,
    reach_m: float = math.inf,
    spread: FloatArray = ISOTROPIC,
) -> UnblurredPlate:
    """Return what every pixel would see of the plate in a pose, if there were no blur.

    Parameters
    ----------
    circles : Circles
        All circles of the plate.
    measured_count : int
        Number of circles, from the first on, that are measured.
    rays : (6, n) array
        As in `Window`.
    small_radius_m : float
        Discs with smaller radii are small.
    reach_m : float
        Distance within which edges are searched.
    spread : (3,) array
        Result of `blur_on_plate`.
    """
    points_m, tables = plate_points(pose, rays), _tables_of(circles)
    seen = _see_circles(points_m, *tables, measured_count, small_radius_m, reach_m, spread)
    return UnblurredPlate(points_m, *seen)


@lru_cache(maxsize=64)
def _tables_of(circles: Circles) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return centre, radius and sign of all circles (4, c), and their distances and groups."""
    table = np.vstack((circles.centres_m, circles.radii_m, circles.signs))
    return table, *distances_and_group_ends(circles.centres_m, circles.radii_m)


@compiled
def _see_circles(
    points_m: FloatArray,
    circles: FloatArray,
    out_m: FloatArray,
    ends: IndexArray,
    measured_count: int,
    small_radius_m: float,
    reach_m: float,
    spread: FloatArray,
) -> FloatArray:
    """Return (4, n): distance from the centre, white share, and both distances from edges.

    The outer loop is over circles: loops over all pixels without a branch are several times as
    fast.
    """
    result = np.empty((4, points_m.shape[1]))
    rho_m, share, edge_distance_m, measured_edge_distance_m = (
        result[0],
        result[1],
        result[2],
        result[3],
    )
    is_small, stretch = np.zeros(len(rho_m), np.bool_), np.empty(len(rho_m))
    for i in range(len(rho_m)):
        x, y = points_m[0, i], points_m[1, i]
        rho_m[i] = math.sqrt(x * x + y * y)
        stretch[i] = _stretch(x, y, spread)
        share[i], edge_distance_m[i], measured_edge_distance_m[i] = 1.0, np.inf, np.inf
    near = np.empty(len(rho_m), np.intp)
    c = 0
    while c < len(ends):
        radius, sign = circles[2, c], circles[3, c]
        if out_m[c] == 0.0:
            _add_ring(rho_m, radius, sign, share, edge_distance_m)
            if c < measured_count:
                _near_ring(rho_m, radius, stretch, measured_edge_distance_m)
            if radius < small_radius_m:
                is_small |= rho_m < radius
            c += 1
            continue
        count = 0
        for i in range(len(rho_m)):
            near[count] = i
            count += abs(rho_m[i] - out_m[c]) < radius + reach_m
        from_x, from_y = _from_nearest(points_m, near[:count], circles[:2, c : ends[c]])
        for k in range(count):
            i, x, y = near[k], from_x[k], from_y[k]
            outside_m = math.sqrt(x * x + y * y) - radius
            edge_distance_m[i] = min(edge_distance_m[i], abs(outside_m))
            if c < measured_count and abs(outside_m) < measured_edge_distance_m[i]:
                scaled_m = abs(outside_m) * _stretch(x, y, spread)
                measured_edge_distance_m[i] = min(measured_edge_distance_m[i], scaled_m)
            share[i] += sign if outside_m < 0.0 else 0.0
            is_small[i] |= outside_m < 0.0 and radius < small_radius_m
        c = ends[c]
    for i in range(len(rho_m)):
        edge_distance_m[i] = 0.0 if is_small[i] else edge_distance_m[i]
    return result


@compiled
def _stretch(x: float, y: float, spread: FloatArray) -> float:
    """Return the upper bound of the blur over the blur in a direction: a factor of at least 1."""
    square = spread[0] * x * x + 2.0 * spread[1] * x * y + spread[2] * y * y
    return math.sqrt((x * x + y * y) / square) if square > 0.0 else 1.0


@compiled
def _add_ring(
    rho_m: FloatArray, radius_m: float, sign: float, share: FloatArray, edge_distance_m: FloatArray
) -> None:
    for i in range(len(rho_m)):
        share[i] += sign if rho_m[i] < radius_m else 0.0
        edge_distance_m[i] = min(edge_distance_m[i], abs(rho_m[i] - radius_m))


@compiled
def _near_ring(
    rho_m: FloatArray, radius_m: float, stretch: FloatArray, measured_edge_distance_m: FloatArray
) -> None:
    for i in range(len(rho_m)):
        measured_edge_distance_m[i] = min(
            measured_edge_distance_m[i], abs(rho_m[i] - radius_m) * stretch[i]
        )


@compiled
def _from_nearest(
    points_m: FloatArray, near: IndexArray, centres_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return x and y (m,) from the nearest of the centres (2, k) to the points with indices `near`.

    The outer loop is over centres, so that the inner one has no branches.
    """
    x, y = np.empty(len(near)), np.empty(len(near))
    from_x, from_y, least = x.copy(), y.copy(), np.full(len(near), np.inf)
    for m in range(len(near)):
        x[m], y[m] = points_m[0, near[m]], points_m[1, near[m]]
    for k in range(centres_m.shape[1]):
        centre_x, centre_y = centres_m[0, k], centres_m[1, k]
        for m in range(len(near)):
            off_x, off_y = x[m] - centre_x, y[m] - centre_y
            square = off_x * off_x + off_y * off_y
            is_nearer = square < least[m]
            from_x[m] = off_x if is_nearer else from_x[m]
            from_y[m] = off_y if is_nearer else from_y[m]
            least[m] = min(least[m], square)
    return from_x, from_y
