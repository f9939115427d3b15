"""From places that may be a ring's to the ellipses of outer edges, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.conic import Ellipse
from kgcp.target.distinct import distinct
from kgcp.target.ellipses import fit_ellipses
from kgcp.target.rays import RAYS, RAYS_RAD, follow
from kgcp.target.seeds import Level, Seeds

_DIRECTIONS = np.stack((np.cos(RAYS_RAD), np.sin(RAYS_RAD)), axis=-1)
_FINEST_RADIUS_PX = 12.0
_MAX_AXIS_RATIO = 2.0
_NEAR, _ALIKE = 0.25, 0.15  # of one ring: distance of centres, of its radius; ratio of radii

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _Outlines:
    """Ellipses (n,) and how clear they are: centres, semi-axes [px], directions [rad]."""

    centres_px: FloatArray
    axes_px: FloatArray
    angles_rad: FloatArray
    clearness: FloatArray

    @property
    def radii_px(self) -> FloatArray:
        """Radii of circles of the same areas."""
        return np.asarray(np.sqrt(self.axes_px.prod(axis=1)))

    def chosen(self, which: IndexArray) -> _Outlines:
        """Return some of them."""
        return _Outlines(
            self.centres_px[which],
            self.axes_px[which],
            self.angles_rad[which],
            self.clearness[which],
        )

    def ellipses(self) -> tuple[Ellipse, ...]:
        """Return them one by one."""
        rows = np.column_stack((self.centres_px, self.axes_px, self.angles_rad)).tolist()
        return tuple(Ellipse(*row) for row in rows)


def find_outlines(pyramid: tuple[Level, ...], seeds: Seeds) -> tuple[Ellipse, ...]:
    """Follow the outer edge of every seed's ring and fit an ellipse to it.

    Twice: the centre of a large ring is known to some pixels at first.
    """
    for _ in range(2):
        if not len(seeds):
            return ()
        outlines = _distinct(_follow(pyramid, seeds))
        seeds = Seeds(outlines.centres_px, outlines.radii_px, np.ones(len(outlines.clearness)))
    return outlines.ellipses()


def _distinct(outlines: _Outlines) -> _Outlines:
    """Drop ellipses that agree with a clearer one; the clearest comes first."""
    kept = distinct(outlines.centres_px, outlines.radii_px, outlines.clearness, _NEAR, _ALIKE)
    return outlines.chosen(kept)


def _follow(pyramid: tuple[Level, ...], seeds: Seeds) -> _Outlines:
    """Return an ellipse for every seed that has an outline."""
    edges = np.empty((len(seeds), RAYS))
    inlying = np.empty((len(seeds), RAYS), dtype=np.bool_)
    wanted = np.floor(np.log2(np.maximum(seeds.radii_px / _FINEST_RADIUS_PX, 1.0))).astype(np.intp)
    wanted = np.minimum(wanted, len(pyramid) - 1)
    centres, radii = np.ascontiguousarray(seeds.centres_px), np.ascontiguousarray(seeds.radii_px)
    for index in set(wanted.tolist()):
        level, which = pyramid[index], np.flatnonzero(wanted == index)
        follow(level.image, float(level.factor), which, centres, radii, edges, inlying)
    share = inlying.mean(axis=1)
    good = np.flatnonzero(share)
    return _fit_ellipses(
        edges[good], inlying[good], seeds.chosen(good), share[good] * seeds.contrasts[good]
    )


def _fit_ellipses(
    edges: FloatArray, inlying: BoolArray, seeds: Seeds, clearness: FloatArray
) -> _Outlines:
    """Fit an ellipse to each seed's edges; what is none is dropped.

    The unit of the edges is the seed's radius, the origin its centre.
    """
    found, possible = np.empty((len(edges), 5)), np.empty(len(edges), dtype=np.bool_)
    fit_ellipses(edges, inlying, _DIRECTIONS, _MAX_AXIS_RATIO, found, possible)
    scale = seeds.radii_px[:, None]
    return _Outlines(
        seeds.centres_px + scale * found[:, :2], scale * found[:, 2:4], found[:, 4], clearness
    ).chosen(np.flatnonzero(possible))
