"""From places that may be a ring's to the ellipses of outer edges, all at once."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import Ellipse
from kgcp.target.distinct import distinct
from kgcp.target.ellipses import fit_ellipses
from kgcp.target.pyramid import Pyramid
from kgcp.target.rays import RAYS, RAYS_RAD, follow
from kgcp.target.seeds import Seeds

_DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)
_MAX_AXIS_RATIO = 2.0
_NEAR, _ALIKE = 0.25, 0.15  # of one ring: distance of centres, of its radius; ratio of radii


def find_outlines(pyramid: Pyramid, seeds: Seeds) -> tuple[Ellipse, ...]:
    """Follow the outer edge of every seed's ring and fit an ellipse to it.

    Twice: the centre of a large ring is known to some pixels at first.
    """
    ellipses = np.empty((0, 5))
    for _ in range(2):
        if not len(seeds):
            return ()
        ellipses = _follow(pyramid, seeds)
        centres, axes = np.ascontiguousarray(ellipses[:, :2]), ellipses[:, 2:4]
        seeds = Seeds(centres, np.sqrt(axes.prod(axis=1)), np.ones(len(ellipses)))
    return tuple(Ellipse(*row) for row in ellipses.tolist())


def _follow(pyramid: Pyramid, seeds: Seeds) -> FloatArray:
    """Return centre, semi-axes [px] and direction [rad] of the seeds' outlines, clearest first.

    Those that agree with a clearer one are dropped. The unit of the edges is the seed's radius, the
    origin its centre.
    """
    edges, inlying = np.empty((len(seeds), RAYS)), np.empty((len(seeds), RAYS), dtype=np.bool_)
    places = seeds.centres_px, seeds.radii_px
    follow(pyramid.frame, pyramid.reduced, pyramid.levels, *places, edges, inlying)
    ellipses, shares = np.empty((len(seeds), 5)), np.empty(len(seeds))
    fit_ellipses(edges, inlying, _DIRECTIONS, _MAX_AXIS_RATIO, ellipses, shares)
    good = np.flatnonzero(shares)
    ellipses, seeds, shares = ellipses[good], seeds.chosen(good), shares[good]
    ellipses[:, :4] *= seeds.radii_px[:, None]
    ellipses[:, :2] += seeds.centres_px
    radii, centres = np.sqrt(ellipses[:, 2:4].prod(axis=1)), np.ascontiguousarray(ellipses[:, :2])
    return ellipses[distinct(centres, radii, shares * seeds.contrasts, _NEAR, _ALIKE)]
