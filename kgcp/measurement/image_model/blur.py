"""The blur, and which pixels it brings within reach of which circle's edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.image_model.plate import Circles
from kgcp.measurement.image_model.quadrature import quadrature_for

REACH_SIGMAS = 3.7  # farther away, a blurred edge is flat to 1e-4 of the contrast
# Least variance of the blur on the plate, relative to the largest. It matters if a plate is seen
# almost edge-on.
_MIN_SPREAD = 1e-4
_SLACK_PX = 0.6  # by how much a circle may move before the incidence is computed again


@dataclass(frozen=True, slots=True, eq=False)
class Blur:
    """The point spread of the image."""

    # covariance of the Gaussian part, including the integration over a pixel [px²]
    xx: float
    yy: float
    xy: float
    # motion during the exposure [px]
    streak_x: float = 0.0
    streak_y: float = 0.0
    # (4,): third cumulants xxx, xxy, xyy, yyy [px³]
    skew: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    kurtosis: float = 0.0  # excess kurtosis of the Gaussian part, the same in all directions

    @property
    def has_streak(self) -> bool:
        """Whether there is motion during the exposure."""
        return bool(self.streak_x or self.streak_y)

    def scaled(self, factor: float) -> Blur:
        """Return the blur with all lengths multiplied by a factor."""
        square = factor * factor
        streak = (factor * self.streak_x, factor * self.streak_y)
        cube = square * factor
        xxx, xxy, xyy, yyy = self.skew
        skew = (cube * xxx, cube * xxy, cube * xyy, cube * yyy)
        return Blur(
            square * self.xx, square * self.yy, square * self.xy, *streak, skew, self.kurtosis
        )

    @property
    def vector(self) -> FloatArray:
        """All values but skew and kurtosis (5,), in the order of the attributes."""
        return np.array([self.xx, self.yy, self.xy, self.streak_x, self.streak_y])

    @property
    def total_covariance(self) -> tuple[float, float, float]:
        """Covariance of the Gaussian part and the streak together: xx, yy, xy [px²]."""
        return (
            self.xx + self.streak_x**2 / 12.0,
            self.yy + self.streak_y**2 / 12.0,
            self.xy + self.streak_x * self.streak_y / 12.0,
        )

    @property
    def largest_sd_px(self) -> float:
        """Standard deviation in the direction of the strongest blur [px]."""
        xx, yy, xy = self.total_covariance
        return math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))

    @property
    def mean_sd_px(self) -> float:
        """Standard deviation averaged over directions [px]."""
        xx, yy, _ = self.total_covariance
        return math.sqrt(0.5 * (xx + yy))


def variance_in_bins(variance_px2: float, count: int) -> float:
    """Return a blur's variance after binning, in squared widths of bins of `count` pixels.

    Both variances include the integration, over a pixel and over a bin.
    """
    return (variance_px2 + (count * count - 1) / 12.0) / (count * count)


def variance_in_pixels(variance: float, count: int) -> float:
    """Return the variance in pixels [px²] of a blur before binning: inverts `variance_in_bins`.

    It is at least that of the integration over a pixel.
    """
    return max(1.0 / 12.0, count * count * variance - (count * count - 1) / 12.0)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeIncidence:
    """Which of n pixels are within reach of the blurred edges of which of c circles."""

    circles: FloatArray  # (c, 5): centre x, y and radius [m], sign, `Quadrature`
    # (c + 1,): the pixels in reach of circle i are members[starts[i]:starts[i + 1]]
    starts: IndexArray
    members: IndexArray
    # (n,): white share of every pixel due to the circles whose edges are out of reach
    background: FloatArray


def find_edge_incidence(
    points_m: FloatArray,
    metres_per_px: float,
    circles: Circles,
    blur: Blur,
    spread: FloatArray,
) -> EdgeIncidence:
    """Find which pixels are within reach of which circles' blurred edges.

    Parameters
    ----------
    points_m : (2, n) array
        Where the pixels' rays meet the plate.
    metres_per_px : float
        Largest length on the plate that a pixel spans.
    spread : (3,) array
        Result of `blur_on_plate`.
    """
    sd_m = blur.largest_sd_px * metres_per_px
    half_range = math.hypot(0.5 * (spread[0] - spread[2]), spread[1])
    least = max(0.5 * (spread[0] + spread[2]) - half_range, _MIN_SPREAD)
    sharpest_m = sd_m * math.sqrt(least)
    table = np.empty((len(circles.radii_m), 5))
    table[:, 0], table[:, 1] = circles.centres_m
    table[:, 2], table[:, 3] = circles.radii_m, circles.signs
    table[:, 4] = quadrature_for(circles.radii_m / sd_m, circles.radii_m / sharpest_m)
    slack_m = _SLACK_PX * metres_per_px
    return EdgeIncidence(table, *_pair_up(points_m, table, REACH_SIGMAS * sd_m, slack_m, spread))


def reach_px(blur: Blur) -> float:
    """Return the distance from an edge within which pixels may see it [px].

    It includes the slack for moves of a circle.
    """
    return REACH_SIGMAS * blur.largest_sd_px + _SLACK_PX


@compiled
def _pair_up(
    points_m: FloatArray,
    circles: FloatArray,
    reach_m: float,
    slack_m: float,
    spread: FloatArray,
) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Return starts, members and background of `EdgeIncidence`.

    A pixel outside a circle is out of reach if it is so along the direction from the circle's
    centre, given the blur in that direction.
    """
    count, member_count, max_reach_m = points_m.shape[1], 0, reach_m + slack_m
    starts, background = np.zeros(len(circles) + 1, np.intp), np.ones(count)
    members = np.empty(2 * count, np.intp)
    for c in range(len(circles)):
        if member_count + count > len(members):
            members = np.concatenate((members, np.empty_like(members)))
        within_m, beyond_m = max(circles[c, 2] - max_reach_m, 0.0), circles[c, 2] + max_reach_m
        for i in range(count):
            dx, dy = points_m[0, i] - circles[c, 0], points_m[1, i] - circles[c, 1]
            square = dx * dx + dy * dy
            if square < within_m * within_m:
                background[i] += circles[c, 3]
            elif square <= beyond_m * beyond_m:
                distance_m = math.sqrt(square)
                spread_m2 = spread[0] * dx * dx + 2.0 * spread[1] * dx * dy + spread[2] * dy * dy
                outside_m = distance_m - circles[c, 2] - slack_m
                if outside_m > 0.0 and outside_m * distance_m > reach_m * math.sqrt(spread_m2):
                    continue
                members[member_count] = i
                member_count += 1
        starts[c + 1] = member_count
    return starts, members[:member_count], background
