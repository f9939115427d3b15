"""The plate without blur: white share of every pixel, and how far it is from the next edge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.plate import EVEN, Circles, find_skips, plate_points


@dataclass(frozen=True, slots=True, eq=False)
class UnblurredPlate:
    """The plate under n pixels."""

    points_m: FloatArray  # (2, n): where the pixels' rays meet the plate
    rho_m: FloatArray  # (n,): distance of the points from the target's centre
    share: FloatArray  # (n,): 0: ink, 1: plate
    # (n,): distance to the nearest edge; 0 in a small disc. Beyond the reach it may be too large.
    off_edge_m: FloatArray
    # (n,): the same, of the circles that are measured, and without regard to small discs; more,
    # where there is less blur across that edge than there may be
    off_measured_m: FloatArray


def unblurred_plate(
    circles: Circles,
    measured_count: int,
    pose: Pose,
    rays: FloatArray,
    *,
    small_m: float = 0.0,
    reach_m: float = math.inf,
    spread: FloatArray = EVEN,
) -> UnblurredPlate:
    """Find what is under every pixel of the plate as a pose puts it, without blur.

    Parameters
    ----------
    circles : Circles
        All of the plate.
    measured_count : int
        How many of them, the first, are measured.
    rays : (6, n) array
        As in `Window`.
    small_m : float
        Radius below which a disc is small.
    reach_m : float
        How far edges are looked for.
    spread : (3,) array
        By `blur_on_plate`.
    """
    points_m, tables = plate_points(pose, rays), _tables_of(circles)
    seen = _see_circles(points_m, *tables, measured_count, small_m, reach_m, spread)
    return UnblurredPlate(points_m, *seen)


@lru_cache(maxsize=64)
def _tables_of(circles: Circles) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return centre, radius and sign of all circles (4, c), and what `find_skips` makes of them."""
    table = np.vstack((circles.centres_m, circles.radii_m, circles.signs))
    return table, *find_skips(circles.centres_m, circles.radii_m)


@compiled
def _see_circles(
    points_m: FloatArray,
    circles: FloatArray,
    out_m: FloatArray,
    beyond: IndexArray,
    measured_count: int,
    small_m: float,
    reach_m: float,
    spread: FloatArray,
) -> FloatArray:
    """Return (4, n): distance from the centre, white share, distances to the nearest edges.

    Circle by circle: loops over all pixels without a branch are several times faster.
    """
    result = np.empty((4, points_m.shape[1]))
    rho_m, share, off_edge_m, off_measured_m = result[0], result[1], result[2], result[3]
    is_small, stretch = np.zeros(len(rho_m), np.bool_), np.empty(len(rho_m))
    for i in range(len(rho_m)):
        x, y = points_m[0, i], points_m[1, i]
        rho_m[i] = math.sqrt(x * x + y * y)
        stretch[i] = _stretch(x, y, spread)
        share[i], off_edge_m[i], off_measured_m[i] = 1.0, np.inf, np.inf
    near = np.empty(len(rho_m), np.intp)
    c = 0
    while c < len(beyond):
        radius, sign = circles[2, c], circles[3, c]
        if out_m[c] == 0.0:
            _add_ring(rho_m, radius, sign, share, off_edge_m)
            if c < measured_count:
                _near_ring(rho_m, radius, stretch, off_measured_m)
            if radius < small_m:
                is_small |= rho_m < radius
            c += 1
            continue
        count = 0
        for i in range(len(rho_m)):
            near[count] = i
            count += abs(rho_m[i] - out_m[c]) < radius + reach_m
        from_x, from_y = _from_nearest(points_m, near[:count], circles[:2, c : beyond[c]])
        for k in range(count):
            i, x, y = near[k], from_x[k], from_y[k]
            beyond_m = math.sqrt(x * x + y * y) - radius
            off_edge_m[i] = min(off_edge_m[i], abs(beyond_m))
            if c < measured_count and abs(beyond_m) < off_measured_m[i]:
                felt_m = abs(beyond_m) * _stretch(x, y, spread)
                off_measured_m[i] = min(off_measured_m[i], felt_m)
            share[i] += sign if beyond_m < 0.0 else 0.0
            is_small[i] |= beyond_m < 0.0 and radius < small_m
        c = beyond[c]
    for i in range(len(rho_m)):
        off_edge_m[i] = 0.0 if is_small[i] else off_edge_m[i]
    return result


@compiled
def _stretch(x: float, y: float, spread: FloatArray) -> float:
    """Return how much less than it may be the blur is in a direction, as a factor above 1."""
    square = spread[0] * x * x + 2.0 * spread[1] * x * y + spread[2] * y * y
    return math.sqrt((x * x + y * y) / square) if square > 0.0 else 1.0


@compiled
def _add_ring(
    rho_m: FloatArray, radius_m: float, sign: float, share: FloatArray, off_edge_m: FloatArray
) -> None:
    for i in range(len(rho_m)):
        share[i] += sign if rho_m[i] < radius_m else 0.0
        off_edge_m[i] = min(off_edge_m[i], abs(rho_m[i] - radius_m))


@compiled
def _near_ring(
    rho_m: FloatArray, radius_m: float, stretch: FloatArray, off_measured_m: FloatArray
) -> None:
    for i in range(len(rho_m)):
        off_measured_m[i] = min(off_measured_m[i], abs(rho_m[i] - radius_m) * stretch[i])


@compiled
def _from_nearest(
    points_m: FloatArray, near: IndexArray, centres_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return where some points, by their index (m,), are from the nearest of some centres (2, k).

    Centre by centre: a loop without a branch.
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
