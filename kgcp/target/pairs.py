"""Blur, and which pixels it lets feel which circle's edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.target.plate import Circles, PlateView, largest_metres_per_px
from kgcp.target.profile import Quadrature, quadrature_for

REACH_SIGMAS = 4.2  # beyond, a blurred edge is flat to 1e-5 of the contrast
_SLACK_PX = 0.7  # what a circle may move before the pairs are made anew


@dataclass(frozen=True, slots=True, eq=False)
class Blur:
    """How an image point spreads.

    Attributes
    ----------
    xx, yy, xy : float
        Covariance of the Gaussian part, pixel integration included [px²].
    streak_x, streak_y : float
        Motion during exposure [px].
    """

    xx: float
    yy: float
    xy: float
    streak_x: float = 0.0
    streak_y: float = 0.0

    @property
    def total_covariance(self) -> tuple[float, float, float]:
        """Covariance of Gaussian and streak together: xx, yy, xy [px²]."""
        return (
            self.xx + self.streak_x**2 / 12.0,
            self.yy + self.streak_y**2 / 12.0,
            self.xy + self.streak_x * self.streak_y / 12.0,
        )

    @property
    def largest_sd_px(self) -> float:
        """Standard deviation along the direction of the strongest blur [px]."""
        xx, yy, xy = self.total_covariance
        return float(np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)))

    @property
    def mean_sd_px(self) -> float:
        """Standard deviation averaged over directions [px]."""
        xx, yy, _ = self.total_covariance
        return float(np.sqrt(0.5 * (xx + yy)))


@dataclass(frozen=True, slots=True, eq=False)
class EdgePairs:
    """Which pixels feel the edge of which circle: m pairs, sorted by rule of integration.

    Attributes
    ----------
    groups : tuple of (Quadrature, slice)
        The pairs of each rule.
    pixel : (m,) array of int
    centre_m : (2, m) array
    radius_m, sign : (m,) array
        Of the pair's circle.
    background : (n,) array
        White share of every pixel from the circles whose edge it does not feel.
    """

    groups: tuple[tuple[Quadrature, slice], ...]
    pixel: IndexArray
    centre_m: FloatArray
    radius_m: FloatArray
    sign: FloatArray
    background: FloatArray


def pair_edges(view: PlateView, circles: Circles, blur: Blur) -> EdgePairs:
    """Find the pairs of pixels and circles whose edges are within reach of the blur."""
    metres_per_px = largest_metres_per_px(view)
    sd_m = blur.largest_sd_px * metres_per_px
    reach_m = REACH_SIGMAS * sd_m + _SLACK_PX * metres_per_px
    order = np.argsort(circles.radii_m)
    rules = [quadrature_for(float(circles.radii_m[index] / sd_m)) for index in order]
    background = np.ones(view.points_m.shape[1])
    pixels = []
    for index in order:
        x, y = view.points_m - circles.centres_m[:, index, None]
        inward = circles.radii_m[index] - np.sqrt(x * x + y * y)
        background[inward > reach_m] += circles.signs[index]
        pixels.append(np.flatnonzero(np.abs(inward) <= reach_m))
    counts = [len(found) for found in pixels]
    circle = np.repeat(order, counts)
    ends = np.cumsum(counts)
    groups = []
    for rule in sorted(set(rules)):
        members = [i for i, other in enumerate(rules) if other is rule]
        groups.append((rule, slice(int(ends[members[0]] - counts[members[0]]), ends[members[-1]])))
    return EdgePairs(
        groups=tuple(groups),
        pixel=np.concatenate(pixels),
        centre_m=circles.centres_m[:, circle],
        radius_m=circles.radii_m[circle],
        sign=circles.signs[circle],
        background=background,
    )
