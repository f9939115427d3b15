"""The plate without blur: white share of every pixel, and how far it is from the next edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.target.imaging import Imaging
from kgcp.target.plate import find_skips, plate_points


@dataclass(frozen=True, slots=True, eq=False)
class BarePlate:
    """The plate under n pixels.

    Attributes
    ----------
    points_m : (2, n) array
        Where the pixels' rays meet the plate.
    rho_m : (n,) array
        Distance of the points from the target's centre.
    share : (n,) array
        0: ink, 1: plate.
    off_edge_m : (n,) array
        Distance to the nearest edge; 0 in a small disc. Beyond the reach it may be too large.
    off_measured_m : (n,) array
        The same, of the circles that are measured, and without regard to small discs.
    """

    points_m: FloatArray
    rho_m: FloatArray
    share: FloatArray
    off_edge_m: FloatArray
    off_measured_m: FloatArray


def look_at_plate(
    imaging: Imaging,
    pose: Pose,
    rays: FloatArray,
    *,
    small_m: float = 0.0,
    reach_m: float = math.inf,
) -> BarePlate:
    """See what is where on the plate.

    Parameters
    ----------
    imaging : Imaging
    pose : Pose
    rays : (6, n) array
        As in `Window`.
    small_m : float
        Radius below which a disc is small.
    reach_m : float
        How far edges are looked for.
    """
    points_m, circles = plate_points(pose, rays), imaging.circles
    centres_m, radii_m, signs = circles.centres_m, circles.radii_m, circles.signs
    skips = find_skips(centres_m, radii_m)
    count = imaging.measured_count
    seen = np.empty((4, points_m.shape[1]))
    _look(points_m, centres_m, radii_m, signs, *skips, count, small_m, reach_m, seen)
    return BarePlate(points_m, *seen)


@compiled
def _look(
    points_m: FloatArray,
    centres_m: FloatArray,
    radii_m: FloatArray,
    signs: FloatArray,
    out_m: FloatArray,
    beyond: IndexArray,
    measured_count: int,
    small_m: float,
    reach_m: float,
    seen: FloatArray,
) -> None:
    """Fill in (4, n): distance from the centre, white share, distances to the nearest edges.

    Circle by circle: loops over all pixels without a branch are several times faster.
    """
    rho_m, share, off_edge_m, off_measured_m = seen[0], seen[1], seen[2], seen[3]
    is_small = np.zeros(len(rho_m), np.bool_)
    for i in range(len(rho_m)):
        rho_m[i] = math.sqrt(points_m[0, i] ** 2 + points_m[1, i] ** 2)
        share[i], off_edge_m[i] = 1.0, np.inf
    c = 0
    while c < len(radii_m):
        if out_m[c] == 0.0:
            _add_ring(rho_m, radii_m[c], signs[c], share, off_edge_m)
            if radii_m[c] < small_m:
                is_small |= rho_m < radii_m[c]
            c += 1
        else:
            dots = centres_m[:, c : beyond[c]]
            within_m = radii_m[c] + reach_m
            for i in range(len(rho_m)):
                if abs(rho_m[i] - out_m[c]) < within_m:
                    nearest = _nearest(points_m[0, i], points_m[1, i], dots) - radii_m[c]
                    off_edge_m[i] = min(off_edge_m[i], abs(nearest))
                    share[i] += signs[c] if nearest < 0.0 else 0.0
                    is_small[i] |= nearest < 0.0 and radii_m[c] < small_m
            c = beyond[c]
        if c == measured_count:
            off_measured_m[:] = off_edge_m
    for i in range(len(rho_m)):
        off_edge_m[i] = 0.0 if is_small[i] else off_edge_m[i]


@compiled
def _add_ring(
    rho_m: FloatArray, radius_m: float, sign: float, share: FloatArray, off_edge_m: FloatArray
) -> None:
    for i in range(len(rho_m)):
        share[i] += sign if rho_m[i] < radius_m else 0.0
        off_edge_m[i] = min(off_edge_m[i], abs(rho_m[i] - radius_m))


@compiled
def _nearest(x: float, y: float, centres_m: FloatArray) -> float:
    """Return the distance from the nearest of some centres (2, k)."""
    least = np.inf
    for k in range(centres_m.shape[1]):
        least = min(least, (x - centres_m[0, k]) ** 2 + (y - centres_m[1, k]) ** 2)
    return math.sqrt(least)
