"""Where a ring may be: bright cores in dark rings in bright surrounds, at all sizes.

A pyramid of reduced images brings rings of every size to a radius of about 3 pixels. There a
difference of small box filters answers to a bright core in a dark ring on a bright plate, and a
ring is what makes up much of the range of grey values around: on textured ground, other things do.
The few places that remain are looked at in the next finer image, in more and more directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.target.distinct import distinct
from kgcp.target.peaks import PEAK_RADIUS_PX, find_peaks
from kgcp.target.pyramid import Pyramid, factor_of
from kgcp.target.ring_samples import look_around

_SMALLEST_RATIO = 0.93  # of rings looked for in a level, to that radius
_NEAR, _ALIKE = 0.3, 0.25  # of one ring: distance of centres, of its radius; ratio of radii


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Places that may be a ring's.

    Attributes
    ----------
    centres_px : (n, 2) array
        In the frame.
    radii_px : (n,) array
        Of the outer circle, to a fifth.
    contrasts : (n,) array
        Grey values by which core and surround are brighter than the ring.
    """

    centres_px: FloatArray
    radii_px: FloatArray
    contrasts: FloatArray

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
    rings = look_around(pyramid, peaks, ends)
    centres, radii, contrasts = np.ascontiguousarray(rings[:, :2]), *rings[:, 2:].T.copy()
    kept = distinct(centres, radii, contrasts, _NEAR, _ALIKE)
    return Seeds(centres, radii, contrasts).chosen(kept)
