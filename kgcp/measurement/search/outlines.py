"""From candidate places to the ellipses of outer edges, one for each ring.

Ring filter, ring check, edge tracking and ellipse fit in turn; circles that are alike are one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.ellipse_fit import fit_ellipses
from kgcp.measurement.search.edge_tracking import RAYS_RAD, track_edges
from kgcp.measurement.search.pyramid import Pyramid, factor_of
from kgcp.measurement.search.ring_check import check_peaks
from kgcp.measurement.search.ring_filter import PEAK_RADIUS_PX, find_peaks

# Tuning: two seeds, or outlines, are the same ring if their centres are nearer than this, of the
# radius, and the logarithms of their radii. Narrower limits leave more of them to track, and cost
# time (`benchmarks.speed.relative_costs`); wider ones take a replica for the ring around it.
_NEAR_SEEDS, _ALIKE_SEEDS = 0.3, 0.25
_NEAR_OUTLINES, _ALIKE_OUTLINES = 0.25, 0.15
_SMALLEST_RATIO = 0.93  # of the radii that a level is searched for to the one of its peaks
_MAX_AXIS_RATIO = 2.0  # tilts to 60°

_DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)


def non_max_suppression(
    centres: FloatArray, radii: FloatArray, clearness: FloatArray, near: float, alike: float
) -> IndexArray:
    """Return the indices of circles without those that are like a clearer one, clearest first.

    Parameters
    ----------
    centres : (n, 2) array
    radii, clearness : (n,) array
    near : float
        Distance up to which two circles may be the same, of the clearer one's radius.
    alike : float
        Difference of the logarithms of their radii up to which they may be.
    """
    order, by_row = np.argsort(-clearness, kind="stable"), np.argsort(centres[:, 1], kind="stable")
    return order[_is_first(centres, radii, order, by_row, near, alike)[order]]


@compiled
def _is_first(
    centres: FloatArray,
    radii: FloatArray,
    order: IndexArray,
    by_row: IndexArray,
    near: float,
    alike: float,
) -> BoolArray:
    """Return which circles (n,) are like no clearer one, from their orders by clearness and row.

    Neighbours are looked for along the rows, up and down from each circle, as far as it reaches.
    """
    first = np.ones(len(radii), np.bool_)
    position, rank = np.empty(len(radii), np.intp), np.empty(len(radii), np.intp)
    for i in range(len(radii)):
        position[by_row[i]], rank[order[i]] = i, i
    for clearer in order:
        if not first[clearer]:
            continue
        reach = near * radii[clearer]
        for step in (-1, 1):
            place = position[clearer] + step
            while 0 <= place < len(by_row):
                other = by_row[place]
                y = centres[other, 1] - centres[clearer, 1]
                if abs(y) > reach:
                    break
                x = centres[other, 0] - centres[clearer, 0]
                if x * x + y * y <= reach * reach and rank[other] > rank[clearer]:
                    first[other] &= abs(math.log(radii[other] / radii[clearer])) > alike
                place += step
    return first


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Places that may be a ring's."""

    centres_px: FloatArray  # (n, 2): in the frame
    radii_px: FloatArray  # (n,): of the outer circle, to a fifth
    contrasts: FloatArray  # (n,): grey values by which core and surround are brighter than the ring

    def __len__(self) -> int:
        """Count the places."""
        return len(self.radii_px)

    def chosen(self, which: IndexArray) -> Seeds:
        """Return some of the seeds."""
        return Seeds(self.centres_px[which], self.radii_px[which], self.contrasts[which])


def find_seeds(pyramid: Pyramid, min_radius_px: float) -> Seeds:
    """Look for rings in all levels that `min_radius_px` needs, and keep the clearest of each."""
    first, last = 0, len(pyramid.levels)
    while first < last and factor_of(first) * PEAK_RADIUS_PX < _SMALLEST_RATIO * min_radius_px:
        first += 1
    peaks, ends = find_peaks(pyramid.reduced, pyramid.levels[first:])
    rings = check_peaks(pyramid, peaks, ends)
    centres, radii, contrasts = np.ascontiguousarray(rings[:, :2]), *rings[:, 2:].T.copy()
    kept = non_max_suppression(centres, radii, contrasts, _NEAR_SEEDS, _ALIKE_SEEDS)
    return Seeds(centres, radii, contrasts).chosen(kept)


def track_outlines(pyramid: Pyramid, seeds: Seeds) -> tuple[Ellipse, ...]:
    """Track the outer edge of every seed's ring and fit an ellipse to it.

    Twice: the centre of a large ring is known to some pixels at first.
    """
    ellipses = np.empty((0, 5))
    for _ in range(2):
        if not len(seeds):
            return ()
        ellipses = _fit_outlines(pyramid, seeds)
        centres, axes = np.ascontiguousarray(ellipses[:, :2]), ellipses[:, 2:4]
        seeds = Seeds(centres, np.sqrt(axes.prod(axis=1)), np.ones(len(ellipses)))
    return tuple(Ellipse(*row) for row in ellipses.tolist())


def _fit_outlines(pyramid: Pyramid, seeds: Seeds) -> FloatArray:
    """Return centre, semi-axes [px] and direction [rad] of the seeds' outlines, clearest first.

    Those that agree with a clearer one are dropped. The unit of the edges is the seed's radius, the
    origin its centre.
    """
    edges, inlying = track_edges(
        pyramid.frame, pyramid.reduced, pyramid.levels, seeds.centres_px, seeds.radii_px
    )
    ellipses, shares = np.empty((len(seeds), 5)), np.empty(len(seeds))
    fit_ellipses(edges, inlying, _DIRECTIONS, _MAX_AXIS_RATIO, ellipses, shares)
    good = np.flatnonzero(shares)
    ellipses, seeds, shares = ellipses[good], seeds.chosen(good), shares[good]
    ellipses[:, :4] *= seeds.radii_px[:, None]
    ellipses[:, :2] += seeds.centres_px
    radii, centres = np.sqrt(ellipses[:, 2:4].prod(axis=1)), np.ascontiguousarray(ellipses[:, :2])
    return ellipses[
        non_max_suppression(
            centres, radii, shares * seeds.contrasts, _NEAR_OUTLINES, _ALIKE_OUTLINES
        )
    ]
