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
    def has_streak(self) -> bool:
        """Tell whether there is motion."""
        return bool(self.streak_x or self.streak_y)

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
    small_groups : tuple of (Quadrature, slice)
        The pairs of each rule, of circles that are small against the blur.
    small, large : slice
        All these, and the pairs of large circles behind them.
    pixel : (m,) array of int
    centre_m : (2, m) array
    radius_m, sign : (m,) array
        Of the pair's circle.
    background : (n,) array
        White share of every pixel from the circles whose edge it does not feel.
    """

    small_groups: tuple[tuple[Quadrature, slice], ...]
    small: slice
    large: slice
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
    ends = [0, *np.cumsum(counts).tolist()]
    groups = []
    for rule in sorted(set(rules) - {Quadrature.EDGE}):
        members = [i for i, other in enumerate(rules) if other is rule]
        groups.append((rule, slice(ends[members[0]], ends[members[-1] + 1])))
    small = slice(0, groups[-1][1].stop if groups else 0)
    return EdgePairs(
        small_groups=tuple(groups),
        small=small,
        large=slice(small.stop, ends[-1]),
        pixel=np.concatenate(pixels),
        centre_m=circles.centres_m[:, circle],
        radius_m=circles.radii_m[circle],
        sign=circles.signs[circle],
        background=background,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """How m pixels stand to the circles whose edges they feel.

    Attributes
    ----------
    rho, x, y : (m,) array
        Distance from the circle's centre [m] and unit direction.
    radial, tangential, mixed : (m,) array
        The blur's covariance in these directions [m²].
    """

    rho: FloatArray
    x: FloatArray
    y: FloatArray
    radial: FloatArray
    tangential: FloatArray
    mixed: FloatArray


def meet(points_m: FloatArray, spread: FloatArray, pairs: EdgePairs, which: slice) -> Meeting:
    """Return how some of the pairs stand to each other.

    Parameters
    ----------
    points_m : (2, n) array
        The pixels on the plate.
    spread : (3, n) array
        The blur's covariance there, xx, xy, yy [m²].
    pairs : EdgePairs
    which : slice
        Of the pairs.
    """
    pixel = pairs.pixel[which]
    x = points_m[0].take(pixel) - pairs.centre_m[0, which]
    y = points_m[1].take(pixel) - pairs.centre_m[1, which]
    rho = np.sqrt(x * x + y * y) + 1e-12
    x /= rho
    y /= rho
    xx, xy, yy = (row.take(pixel) for row in spread)
    radial = (xx * x + 2.0 * xy * y) * x + yy * y * y
    return Meeting(
        rho=rho,
        x=x,
        y=y,
        radial=radial,
        tangential=xx + yy - radial,
        mixed=(yy - xx) * x * y + xy * (x * x - y * y),
    )
