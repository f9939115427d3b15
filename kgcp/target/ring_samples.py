"""Grey values on circles around many places at once: how dark a ring is, and how even."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray

_RING, _SURROUND = 0.76, (1.15, 1.34)  # circles that are looked at, of the ring's radius
_CORE = 0.33  # circle in the core, outside of a replica
_FINE = 24  # directions
_MIN_CONTRAST = 5  # grey values
_SAME_WHITE = 0.8  # core and surround may differ by so much, of the contrast


@dataclass(frozen=True, slots=True, eq=False)
class RingSamples:
    """Grey values around places that may be a ring's.

    Attributes
    ----------
    values : (pixels,) array of uint8
        A flattened image.
    width : int
        Of the image [px].
    places : (n,) array
        Indices of the rings' centres.
    radii : (n,) array
        Of their outer circles [px].
    """

    values: GreyArray
    width: int
    places: IndexArray
    radii: FloatArray

    def chosen(self, which: IndexArray) -> RingSamples:
        """Return some of them."""
        return RingSamples(self.values, self.width, self.places[which], self.radii[which])

    def stretched(self, factor: float | FloatArray) -> RingSamples:
        """Return the same with other radii."""
        return RingSamples(self.values, self.width, self.places, factor * self.radii)

    def around(self, ratio: float, count: int) -> GreyArray:
        """Return grey values (count, n) on circles of so many times the radii.

        Beyond the image's border there are values of other places: a ring that is cut is like one
        that is partly hidden.
        """
        radii, kinds = np.unique(self.radii, return_inverse=True)
        angles = 2.0 * np.pi / count * (np.arange(count) + 0.5)[:, None]
        x, y = np.rint(ratio * radii * np.stack((np.cos(angles), np.sin(angles))))
        offsets = (y * self.width + x).astype(np.intp)
        places = np.take(offsets, kinds, axis=1)
        places += self.places
        return np.take(self.values, places, mode="clip")

    def surround(self, count: int) -> GreyArray:
        """Return the brighter (count, n) of two circles outside."""
        near, far = (self.around(ratio, count) for ratio in _SURROUND)
        return np.maximum(near, far)

    def ring_directions(self, middle: FloatArray, count: int) -> IndexArray:
        """Count the directions in which a dark ring is followed by a brighter surround."""
        dark = self.around(_RING, count) < middle
        return np.asarray(np.sum(dark & (self.surround(count) > middle), axis=0))

    def clearness(self, clear: FloatArray) -> FloatArray:
        """Return contrasts (n,), less spreads; 0 where they are spread by more than `clear`."""
        ring, core, plate = (
            np.sort(part, axis=0).astype(np.int16)
            for part in (
                self.around(_RING, _FINE),
                self.around(_CORE, _FINE),
                self.surround(_FINE),
            )
        )
        contrast = np.minimum(core[11], plate[14]) - ring[4]
        spread = ring[8] - ring[1]
        limit = clear * contrast
        good = (contrast >= _MIN_CONTRAST) & (spread <= limit)
        good &= (core[17] - core[7] <= limit) & (plate[19] - plate[11] <= limit)
        good &= np.abs(core[11] - plate[14]) <= _SAME_WHITE * contrast
        return np.where(good, np.maximum(contrast - 0.5 * spread, 1.0), 0.0)
