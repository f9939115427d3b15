"""Where a ring may be: bright cores in dark rings in bright surrounds, at all sizes.

A pyramid of reduced images brings rings of every size to a radius of about 3 pixels. There a
difference of small box filters answers to a bright core in a dark ring on a bright plate, and a
ring is what makes up much of the range of grey values around: on textured ground, other things do.
The few places that remain are looked at in the next finer image, in more and more directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.target.distinct import distinct
from kgcp.target.peaks import PEAK_RADIUS_PX, find_peaks
from kgcp.target.ring_samples import look_around

_BRIGHTEST_QUANTILE = 0.999
_SMALLEST_LEVEL_PX = 6
_SMALLEST_RATIO = 0.93  # of rings looked for in a level, to that radius
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of ring, core and surround, of the contrast
_LARGE_PX = 22.0  # radius from which there are few seeds
_NEAR, _ALIKE = 0.3, 0.25  # of one ring: distance of centres, of its radius; ratio of radii

_Sums = npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A frame, reduced.

    Attributes
    ----------
    image : (height, width) array of uint8
    factor : float
        How many pixels of the frame a pixel of the level is wide.
    """

    image: GreyArray
    factor: float

    def to_frame(self, pixels: FloatArray) -> FloatArray:
        """Return coordinates in the frame of coordinates in the level [px]."""
        return np.asarray(self.factor * (pixels + 0.5) - 0.5)


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


def eight_bit(grey: GreyArray) -> GreyArray:
    """Return an 8-bit frame for the search.

    A 16-bit frame often holds 10 or 12 bits: its range is stretched to its brightest pixels.
    """
    if grey.dtype == np.uint8:
        return np.ascontiguousarray(grey)
    white = max(float(np.quantile(grey[::4, ::4], _BRIGHTEST_QUANTILE)), 1.0)
    return cv2.convertScaleAbs(grey, alpha=255.0 / white)


def build_pyramid(grey: GreyArray) -> tuple[Level, ...]:
    """Return the frame itself in 8 bits and its halves, down to some pixels."""
    levels = [Level(eight_bit(grey), 1)]
    while min(levels[-1].image.shape) >= 2 * _SMALLEST_LEVEL_PX:
        image = levels[-1].image
        height, width = image.shape[0] // 2, image.shape[1] // 2
        half = cv2.resize(
            image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
        )
        levels.append(Level(half, 2 * levels[-1].factor))
    return tuple(levels)


def find_seeds(pyramid: tuple[Level, ...], min_radius_px: float) -> Seeds:
    """Look for rings in all levels that `min_radius_px` needs."""
    found = [
        _seeds_of(level, finer)
        for finer, half in pairwise(pyramid)
        for level in (half, _third(half))
        if level.factor * PEAK_RADIUS_PX >= _SMALLEST_RATIO * min_radius_px
    ]
    return _distinct(_joined(found))


def _third(half: Level) -> Level:
    """Return a level whose pixels are half as wide again."""
    height, width = (size // 3 for size in half.image.shape)
    image = np.empty((2 * height, 2 * width), np.uint8)
    _fill_from_three(half.image, image)
    return Level(image, 1.5 * half.factor)


@compiled
def _fill_from_three(image: GreyArray, out: GreyArray) -> None:
    """Make two rows and columns of three, interpolating linearly between pixels' centres."""
    height, width = out.shape[0] // 2, out.shape[1] // 2
    upper, lower = np.empty(3 * width, np.uint16), np.empty(3 * width, np.uint16)
    for i in range(height):
        for x in range(len(upper)):
            upper[x] = 3 * image[3 * i, x] + image[3 * i + 1, x]
        for x in range(len(lower)):
            lower[x] = image[3 * i + 1, x] + 3 * image[3 * i + 2, x]
        _fill_row(upper, out[2 * i])
        _fill_row(lower, out[2 * i + 1])


@compiled
def _fill_row(row: _Sums, out: GreyArray) -> None:
    """Make two columns of three, of sums that are four times the grey values."""
    for j in range(len(out) // 2):
        left, middle, right = row[3 * j], row[3 * j + 1], row[3 * j + 2]
        out[2 * j] = np.uint16(3 * left + middle + 8) >> 4
        out[2 * j + 1] = np.uint16(middle + 3 * right + 8) >> 4


def _seeds_of(level: Level, finer: Level) -> Seeds:
    """Find peaks in a level, and look around them in a finer one."""
    points, middles = find_peaks(level.image)
    radius = PEAK_RADIUS_PX * level.factor
    stretches, clearness = look_around(
        *(finer.image, points, middles, level.factor / finer.factor, PEAK_RADIUS_PX),
        _CLEAR_LARGE if radius >= _LARGE_PX else _CLEAR,
    )
    good = np.flatnonzero(clearness)
    return Seeds(level.to_frame(points[good]), radius * stretches[good], clearness[good])


def _joined(parts: list[Seeds]) -> Seeds:
    if not parts:
        return Seeds(np.empty((0, 2)), np.empty(0), np.empty(0))
    return Seeds(
        np.concatenate([seeds.centres_px for seeds in parts]),
        np.concatenate([seeds.radii_px for seeds in parts]),
        np.concatenate([seeds.contrasts for seeds in parts]),
    )


def _distinct(seeds: Seeds) -> Seeds:
    """Keep the clearest of seeds that are nearly in one place and of one size."""
    kept = distinct(seeds.centres_px, seeds.radii_px, seeds.contrasts, _NEAR, _ALIKE)
    return seeds.chosen(kept)
