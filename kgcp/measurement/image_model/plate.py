"""The circles of a plate, and where the rays of pixels meet the plate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.targets.layout import Ring

_SAME_DISTANCE = 1e-6  # relative to a circle's radius
ISOTROPIC = np.array(
    [1.0, 0.0, 1.0]
)  # `blur_on_plate` of a blur that is the same in all directions


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles on the plate, as arrays."""

    centres_m: FloatArray  # (2, c)
    radii_m: FloatArray  # (c,)
    signs: FloatArray  # (c,): +1: white within; −1: black within

    def part(self, which: slice) -> Circles:
        """Return a slice of the circles."""
        return Circles(self.centres_m[:, which], self.radii_m[which], self.signs[which])


@cache
def circles_of(rings: tuple[Ring, ...]) -> Circles:
    """Return all circles of concentric rings: for each the outer, the inner, and the dots."""
    centres: list[FloatArray] = []
    radii: list[float] = []
    signs: list[float] = []
    for ring in rings:
        dots = ring.dot_centres_m()
        centres += [np.zeros((2, 2)), dots]
        radii += [0.5 * ring.outer_diameter_m, 0.5 * ring.inner_diameter_m]
        radii += [0.5 * ring.dot_diameter_m] * len(dots)
        signs += [-1.0, 1.0] + [1.0] * len(dots)
    return Circles(np.vstack(centres).T.copy(), np.array(radii), np.array(signs))


def plate_points(pose: Pose, rays: FloatArray) -> FloatArray:
    """Return the points (2, n) on the plate [m] that the rays (6, n) of pixels meet."""
    points = np.empty((2, rays.shape[1]))
    _intersect(pose.rotation, pose.translation_m, rays, points)
    return points


@compiled
def _intersect(axes: FloatArray, offset: FloatArray, rays: FloatArray, points: FloatArray) -> None:
    height, along = 0.0, np.zeros(2)
    for k in range(3):
        height += axes[k, 2] * offset[k]
        for j in range(2):
            along[j] += axes[k, j] * offset[k]
    for i in range(rays.shape[1]):
        x, y = rays[0, i], rays[1, i]
        depth = height / (axes[0, 2] * x + axes[1, 2] * y + axes[2, 2])
        for j in range(2):
            points[j, i] = depth * (axes[0, j] * x + axes[1, j] * y + axes[2, j]) - along[j]


def largest_metres_per_px(pose: Pose, rays: FloatArray) -> float:
    """Return the largest length on the plate that a pixel spans, of those with rays (6, n) [m]."""
    return math.sqrt(_largest_square(pose.rotation, pose.translation_m, rays))


@compiled
def _largest_square(axes: FloatArray, offset: FloatArray, rays: FloatArray) -> float:
    """Return the largest squared length on the plate of a raw pixel's side, along x or y [m²]."""
    largest = 0.0
    for i in range(rays.shape[1]):
        xx, xy, yx, yy = _scales(axes, offset, rays[:, i])
        largest = max(largest, xx * xx + yx * yx, xy * xy + yy * yy)
    return largest


@compiled
def _scales(
    axes: FloatArray, offset: FloatArray, ray: FloatArray
) -> tuple[float, float, float, float]:
    """Return the metres on the plate, along its x or y, per raw pixel along x or y.

    The order is xx, xy, yx, yy; the first letter is the plate's axis.
    """
    facing = axes[0, 2] * ray[0] + axes[1, 2] * ray[1] + axes[2, 2]
    height = axes[0, 2] * offset[0] + axes[1, 2] * offset[1] + axes[2, 2] * offset[2]
    depth, scales = height / facing, np.empty((2, 2))
    for j in range(2):
        share = (axes[0, j] * ray[0] + axes[1, j] * ray[1] + axes[2, j]) / facing
        slide_x, slide_y = axes[0, j] - share * axes[0, 2], axes[1, j] - share * axes[1, 2]
        for k in range(2):
            scales[j, k] = depth * (slide_x * ray[2 + k] + slide_y * ray[4 + k])
    return scales[0, 0], scales[0, 1], scales[1, 0], scales[1, 1]


def blur_on_plate(
    pose: Pose, ray: FloatArray, covariance: tuple[float, float, float], sd_m: float
) -> FloatArray:
    """Return the covariance (3,) of the blur on the plate: xx, xy, yy, in units of sd_m².

    Parameters
    ----------
    ray : (6,) array
        Ray of a pixel on the plate, as in `Window`.
    covariance : (3,) tuple
        Covariance of the blur in the image: xx, yy, xy [px²].
    sd_m : float
        Upper bound of the blur's standard deviation on the plate.
    """
    a, b, c, d = _scales(pose.rotation, pose.translation_m, ray)
    xx, yy, xy = covariance
    along_x, along_y = xx * a + xy * b, xy * a + yy * b
    mixed, across = along_x * c + along_y * d, (xx * c + 2.0 * xy * d) * c + yy * d * d
    return np.array((along_x * a + along_y * b, mixed, across)) / (sd_m * sd_m)


@compiled
def distances_and_group_ends(
    centres_m: FloatArray, radii_m: FloatArray
) -> tuple[FloatArray, IndexArray]:
    """Return the centres' distances (c,) from the target's centre, and where similar circles end.

    The dots of a ring have the same radius and distance, so that they can be processed together:
    the circles from c to ends[c] − 1 are similar.
    """
    count = len(radii_m)
    out_m, ends = np.sqrt(centres_m[0] ** 2 + centres_m[1] ** 2), np.empty(count, np.intp)
    for c in range(count - 1, -1, -1):
        ends[c] = c + 1
        is_like_next = c + 1 < count and radii_m[c] == radii_m[c + 1]
        if is_like_next and abs(out_m[c] - out_m[c + 1]) < _SAME_DISTANCE * radii_m[c]:
            ends[c] = ends[c + 1]
    return out_m, ends
