"""Where a ring may be: bright cores in dark rings in bright surrounds, at all sizes.

A pyramid of reduced images brings rings of every size to a radius of about 3 pixels. There a
difference of small box filters answers to a bright core in a dark ring on a bright plate, and a
ring is what makes up much of the range of grey values around: on textured ground, other things do.
The few places that remain are looked at in the next finer image, in more and more directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.target.peaks import PEAK_RADIUS_PX, find_peaks
from kgcp.target.ring_samples import RingSamples

_BRIGHTEST_QUANTILE = 0.999
_SMALLEST_LEVEL_PX = 6
_SMALLEST_RATIO = 0.93  # of rings looked for in a level, to that radius
_FIRST_SMALL = 2  # level of the pyramid whose image is small
_STRETCHES = (0.85, 1.1)
_FEW, _MANY = 8, 16  # directions
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 7  # hidden quarters and dots leave less than half of the ring
_FINE_STRETCHES = (0.9, 1.0, 1.1)
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of ring, core and surround, of the contrast
_LARGE_PX = 22.0  # radius from which there are few seeds


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

    def from_frame(self, pixels: FloatArray) -> FloatArray:
        """Return coordinates in the level of coordinates in the frame [px]."""
        return np.asarray((pixels + 0.5) / self.factor - 0.5)


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

    def stretched(self, factor: FloatArray) -> Seeds:
        """Return the seeds with other radii."""
        return Seeds(self.centres_px, factor * self.radii_px, self.contrasts)


def eight_bit(grey: GreyArray) -> GreyArray:
    """Return an 8-bit frame for the search.

    A 16-bit frame often holds 10 or 12 bits: its range is stretched to its brightest pixels.
    """
    if grey.dtype == np.uint8:
        return grey
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
    found = [Seeds(np.empty((0, 2)), np.empty(0), np.empty(0))]
    for image, levels in _sheets(pyramid, min_radius_px):
        peaks = [_peaks(level) for level, _, _ in levels]
        seeds = _joined(peaks)
        circles = _circles_around(image, levels, peaks)
        found.append(_clear_rings(*_ring_like(circles, seeds)))
    return _distinct(_joined(found))


_Searched = tuple[Level, Level, int]  # level, a finer one, the finer one's first row in a sheet


def _sheets(
    pyramid: tuple[Level, ...], min_radius_px: float
) -> Iterator[tuple[GreyArray, list[_Searched]]]:
    """Yield images to look closer in, and the levels whose peaks are looked at there.

    All small images are put on one sheet: each costs time, whatever its size.
    """
    width = pyramid[min(_FIRST_SMALL, len(pyramid) - 1)].image.shape[1]
    sheet, levels, row = [], [], 0
    for index, (finer, half) in enumerate(pairwise(pyramid)):
        searched = [
            level
            for level in (half, _third(half))
            if level.factor * PEAK_RADIUS_PX >= _SMALLEST_RATIO * min_radius_px
        ]
        if index < _FIRST_SMALL:
            if searched:
                yield finer.image, [(level, finer, 0) for level in searched]
            continue
        levels += [(level, finer, row) for level in searched]
        padding = (0, 0, 0, width - finer.image.shape[1])
        sheet.append(cv2.copyMakeBorder(finer.image, *padding, cv2.BORDER_REPLICATE))
        row += len(finer.image)
    if levels:
        yield np.concatenate(sheet), levels


def _third(half: Level) -> Level:
    """Return a level whose pixels are half as wide again."""
    height, width = (size // 3 for size in half.image.shape)
    image = half.image[: 3 * height, : 3 * width]
    return Level(cv2.resize(image, (2 * width, 2 * height)), 1.5 * half.factor)


def _joined(parts: list[Seeds]) -> Seeds:
    return Seeds(
        np.concatenate([seeds.centres_px for seeds in parts]),
        np.concatenate([seeds.radii_px for seeds in parts]),
        np.concatenate([seeds.contrasts for seeds in parts]),
    )


def _distinct(seeds: Seeds) -> Seeds:
    """Keep the clearest of seeds that are nearly in one place and of one size."""
    order = np.argsort(-seeds.contrasts, kind="stable")
    x, y = seeds.centres_px[order].T
    radius = seeds.radii_px[order]
    free = np.ones(len(order), dtype=bool)
    kept = []
    for i in range(len(order)):
        if free[i]:
            kept.append(order[i])
            later = slice(i + 1, None)
            near = (x[later] - x[i]) ** 2 + (y[later] - y[i]) ** 2 < (0.3 * radius[i]) ** 2
            alike = np.abs(radius[later] - radius[i]) < 0.25 * radius[i]
            free[later] &= ~(near & alike)
    return seeds.chosen(np.array(kept, dtype=np.intp))


def _peaks(level: Level) -> Seeds:
    points, middles = find_peaks(level.image)
    radii = np.full(len(points), PEAK_RADIUS_PX * level.factor)
    return Seeds(level.to_frame(points), radii, middles)


def _circles_around(image: GreyArray, levels: list[_Searched], peaks: list[Seeds]) -> RingSamples:
    """Return the circles of the levels' peaks in a sheet."""
    width = image.shape[1]
    places, radii = [], []
    for (_, finer, row), seeds in zip(levels, peaks, strict=True):
        x, y = np.rint(finer.from_frame(seeds.centres_px)).astype(np.intp).T
        places.append((y + row) * width + x)
        radii.append(seeds.radii_px / finer.factor)
    return RingSamples(image.ravel(), width, np.concatenate(places), np.concatenate(radii))


def _ring_like(circles: RingSamples, seeds: Seeds) -> tuple[RingSamples, Seeds]:
    """Keep those with dark and then bright in some of eight directions."""
    best, stretch = np.zeros(len(seeds), dtype=np.intp), np.ones(len(seeds))
    for trial in _STRETCHES:
        count = circles.stretched(trial).ring_directions(seeds.contrasts, _FEW)
        stretch[count > best] = trial
        best = np.maximum(best, count)
    good = np.flatnonzero(best >= _ENOUGH_OF_FEW)
    return circles.stretched(stretch).chosen(good), seeds.stretched(stretch).chosen(good)


def _clear_rings(circles: RingSamples, seeds: Seeds) -> Seeds:
    """Keep those whose ring, core and surround are each of one grey value, dots apart.

    Parameters
    ----------
    circles : RingSamples
    seeds : Seeds
        With grey values midway between ring and core as `contrasts`; those kept have contrasts,
        less spreads.
    """
    count = len(seeds)
    trials = np.repeat(_FINE_STRETCHES, count)
    every = np.tile(np.arange(count), len(_FINE_STRETCHES))
    tried = circles.chosen(every).stretched(trials)
    seen = np.flatnonzero(tried.ring_directions(seeds.contrasts[every], _MANY) >= _ENOUGH_OF_MANY)
    limits = np.where(seeds.radii_px >= _LARGE_PX, _CLEAR_LARGE, _CLEAR)
    clearness = np.zeros(len(every))
    clearness[seen] = tried.chosen(seen).clearness(limits[every][seen])
    by_trial = clearness.reshape(len(_FINE_STRETCHES), count)
    best = by_trial.max(axis=0)
    good = np.flatnonzero(best)
    stretched = seeds.stretched(np.array(_FINE_STRETCHES)[by_trial.argmax(axis=0)])
    return Seeds(stretched.centres_px[good], stretched.radii_px[good], best[good])
