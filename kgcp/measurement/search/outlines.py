"""The ellipses of the outer edges of all dark rings in a frame.

Ring filter, ring check, edge tracking and ellipse fit are applied in turn. Of circles that are
alike, only the clearest is kept.
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
from kgcp.measurement.search.pyramid import Pyramid, reduction_factor
from kgcp.measurement.search.ring_check import check_peaks
from kgcp.measurement.search.ring_filter import PEAK_RADIUS_PX, find_peaks

# Tuning. Two seeds, or two outlines, are the same ring if the distance of their centres is below
# the first limit (relative to the clearer one's radius) and the difference of the logarithms of
# their radii below the second. With narrower limits more of them are left to be tracked, which
# costs time (`benchmarks.speed.relative_costs`). With wider limits a replica is taken for the ring
# around it.
_MAX_SEED_DISTANCE, _MAX_SEED_LOG_RATIO = 0.3, 0.25
_MAX_OUTLINE_DISTANCE, _MAX_OUTLINE_LOG_RATIO = 0.25, 0.15
# A level is searched if the radius that its peaks stand for is at least this share of the smallest
# radius that is looked for.
_MIN_RADIUS_SHARE = 0.93
_MAX_AXIS_RATIO = 2.0  # corresponds to a tilt of 60°

_DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)


def non_max_suppression(
    centres: FloatArray,
    radii: FloatArray,
    clearness: FloatArray,
    max_distance: float,
    max_log_ratio: float,
) -> IndexArray:
    """Return the indices of circles that are not similar to a clearer one, the clearest first.

    Parameters
    ----------
    centres : (n, 2) array
    radii, clearness : (n,) arrays
    max_distance : float
        Largest distance of the centres of similar circles, relative to the clearer one's radius.
    max_log_ratio : float
        Largest difference of the logarithms of their radii.
    """
    order, by_row = np.argsort(-clearness, kind="stable"), np.argsort(centres[:, 1], kind="stable")
    return order[_is_first(centres, radii, order, by_row, max_distance, max_log_ratio)[order]]


@compiled
def _is_first(
    centres: FloatArray,
    radii: FloatArray,
    order: IndexArray,
    by_row: IndexArray,
    max_distance: float,
    max_log_ratio: float,
) -> BoolArray:
    """Return which circles (n,) are not similar to a clearer one.

    `order` lists the circles by clearness, `by_row` by the row of their centres. Neighbours are
    searched in `by_row`, in both directions from each circle as far as it reaches.
    """
    first = np.ones(len(radii), np.bool_)
    position, rank = np.empty(len(radii), np.intp), np.empty(len(radii), np.intp)
    for i in range(len(radii)):
        position[by_row[i]], rank[order[i]] = i, i
    for clearer in order:
        if not first[clearer]:
            continue
        reach = max_distance * radii[clearer]
        for step in (-1, 1):
            place = position[clearer] + step
            while 0 <= place < len(by_row):
                other = by_row[place]
                y = centres[other, 1] - centres[clearer, 1]
                if abs(y) > reach:
                    break
                x = centres[other, 0] - centres[clearer, 0]
                if x * x + y * y <= reach * reach and rank[other] > rank[clearer]:
                    first[other] &= abs(math.log(radii[other] / radii[clearer])) > max_log_ratio
                place += step
    return first


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Places where a ring may be."""

    centres_px: FloatArray  # (n, 2): in the frame
    radii_px: FloatArray  # (n,): of the outer circle, accurate to a fifth
    contrasts: FloatArray  # (n,): clearness in grey values, from `check_peaks`

    def __len__(self) -> int:
        """Return the number of seeds."""
        return len(self.radii_px)

    def chosen(self, which: IndexArray) -> Seeds:
        """Return the seeds with the given indices."""
        return Seeds(self.centres_px[which], self.radii_px[which], self.contrasts[which])


def find_seeds(pyramid: Pyramid, min_radius_px: float) -> Seeds:
    """Find seeds in all levels that rings from `min_radius_px` on need; similar ones are merged."""
    first, last = 0, len(pyramid.levels)
    while (
        first < last
        and reduction_factor(first) * PEAK_RADIUS_PX < _MIN_RADIUS_SHARE * min_radius_px
    ):
        first += 1
    peaks, ends = find_peaks(pyramid.reduced, pyramid.levels[first:])
    rings = check_peaks(pyramid, peaks, ends)
    centres, radii, contrasts = np.ascontiguousarray(rings[:, :2]), *rings[:, 2:].T.copy()
    kept = non_max_suppression(centres, radii, contrasts, _MAX_SEED_DISTANCE, _MAX_SEED_LOG_RATIO)
    return Seeds(centres, radii, contrasts).chosen(kept)


def track_outlines(pyramid: Pyramid, seeds: Seeds) -> tuple[Ellipse, ...]:
    """Track the outer edge of every seed's ring and fit an ellipse to it.

    This is done twice, because the seed of a large ring knows its centre only to some pixels.
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
    """Return centre, semi-axes [px] and direction [rad] of the seeds' outlines, the clearest first.

    Outlines that are similar to a clearer one are dropped.
    """
    edges, inlying = track_edges(
        pyramid.frame, pyramid.reduced, pyramid.levels, seeds.centres_px, seeds.radii_px
    )
    ellipses, shares = np.empty((len(seeds), 5)), np.empty(len(seeds))
    fit_ellipses(edges, inlying, _DIRECTIONS, _MAX_AXIS_RATIO, ellipses, shares)
    good = np.flatnonzero(shares)
    ellipses, seeds, shares = ellipses[good], seeds.chosen(good), shares[good]
    # edges are relative to the seed's centre and radius
    ellipses[:, :4] *= seeds.radii_px[:, None]
    ellipses[:, :2] += seeds.centres_px
    radii, centres = np.sqrt(ellipses[:, 2:4].prod(axis=1)), np.ascontiguousarray(ellipses[:, :2])
    return ellipses[
        non_max_suppression(
            centres, radii, shares * seeds.contrasts, _MAX_OUTLINE_DISTANCE, _MAX_OUTLINE_LOG_RATIO
        )
    ]
