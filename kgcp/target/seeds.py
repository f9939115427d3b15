"""Where a ring may be: bright cores in dark rings in bright surrounds, at all sizes.

A pyramid of halved images brings rings of every size to radii between 3 and 6 pixels. There the
maxima of a difference of two box filters are places brighter than what is around them; few of them
also have dark around them in most directions, and bright again beyond.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray

_BRIGHTEST_QUANTILE = 0.999
_SMALLEST_PX = 3.0  # radius of a ring that a level of the pyramid still shows
_SMALLEST_LEVEL_PX = 6
_MIN_CONTRAST = 5  # grey values
_STRETCHES = (0.84, 1.0, 1.19)
_RING, _SURROUND = 0.76, (1.15, 1.34)  # circles that are looked at, of the ring's radius
_FEW, _MANY = 8, 16  # directions
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 7  # hidden quarters and dots leave less than half of the ring
_MARGIN_PX = 10
_FINE, _FINE_STRETCHES = 24, (0.9, 1.0, 1.1)
_CORE = 0.33  # circle in the core, of the ring's radius
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of ring, core and surround, of the contrast
_LARGE_FACTOR = 8  # from this level on, where there are few seeds
_SAME_WHITE = 0.8  # core and surround may differ by so much, of the contrast


@dataclass(frozen=True, slots=True)
class _Scale:
    """Radius [px], and how far aside the ring is looked at in four directions [px]."""

    radius: float
    core_box: int
    aside: tuple[tuple[int, int], ...]


_SCALES = (
    _Scale(3.6, 3, ((2, 2), (-2, 2), (-2, -2), (2, -2))),
    _Scale(5.1, 5, ((4, 0), (0, 4), (-4, 0), (0, -4))),
)


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A frame, reduced.

    Attributes
    ----------
    image : (height, width) array of uint8
    factor : int
        How many pixels of the frame a pixel of the level is wide.
    """

    image: GreyArray
    factor: int

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
    found = []
    for finer, level in pairwise(pyramid):
        if level.factor * 2.0 * _SMALLEST_PX > min_radius_px:
            seeds = _joined([_seeds_of_level(level, scale) for scale in _SCALES])
            found.append(_clear_rings(finer, seeds))
    return _distinct(_joined(found))


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


def _clear_rings(level: Level, seeds: Seeds) -> Seeds:
    """Keep seeds whose ring, core and surround are each of one grey value, dots apart.

    Parameters
    ----------
    level : Level
        A finer one than the seeds were found in.
    seeds : Seeds
        With grey values midway between ring and core as `contrasts`; those kept have contrasts,
        less spreads.
    """
    margin = 4 * _MARGIN_PX
    padded = cv2.copyMakeBorder(level.image, *(margin,) * 4, cv2.BORDER_REPLICATE)
    values, width = padded.ravel(), padded.shape[1]
    place = np.rint(level.from_frame(seeds.centres_px)).astype(np.intp) + margin
    places, radii = place[:, 1] * width + place[:, 0], seeds.radii_px / level.factor
    clear = _CLEAR_LARGE if 2 * level.factor >= _LARGE_FACTOR else _CLEAR
    best, stretch = np.zeros(len(seeds)), np.ones(len(seeds))
    for trial in _FINE_STRETCHES:
        circles = _Circles(values, width, places, trial * radii)
        seen = np.flatnonzero(circles.ring_directions(seeds.contrasts) >= _ENOUGH_OF_MANY)
        clearness = circles.chosen(seen).clearness(clear)
        better = clearness > best[seen]
        best[seen[better]] = clearness[better]
        stretch[seen[better]] = trial
    good = best > 0.0
    return Seeds(seeds.centres_px[good], (seeds.radii_px * stretch)[good], best[good])


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Places (n,) in a flattened image of some width, and radii (n,) of rings there [px]."""

    values: GreyArray
    width: int
    places: IndexArray
    radii: FloatArray

    def chosen(self, which: IndexArray) -> _Circles:
        return _Circles(self.values, self.width, self.places[which], self.radii[which])

    def around(self, ratio: float, count: int) -> GreyArray:
        """Return grey values (n, count) on circles of so many times the radii."""
        angles = 2.0 * np.pi / count * (np.arange(count) + 0.5)
        rays = ratio * self.radii[:, None]
        x = np.rint(rays * np.cos(angles)).astype(np.intp)
        y = np.rint(rays * np.sin(angles)).astype(np.intp)
        return np.asarray(self.values[self.places[:, None] + y * self.width + x])

    def surround(self, count: int) -> GreyArray:
        """Return the brighter (n, count) of two circles outside."""
        near, far = (self.around(ratio, count) for ratio in _SURROUND)
        return np.maximum(near, far)

    def ring_directions(self, middle: FloatArray) -> IndexArray:
        """Count the directions in which a dark ring is followed by a brighter surround."""
        dark = self.around(_RING, _MANY) < middle[:, None]
        return np.asarray(np.sum(dark & (self.surround(_MANY) > middle[:, None]), axis=1))

    def clearness(self, clear: float) -> FloatArray:
        """Return contrasts (n,), less spreads; 0 where they are spread by more than `clear`."""
        ring, core, plate = (
            np.sort(part, axis=1).astype(np.int16)
            for part in (
                self.around(_RING, _FINE),
                self.around(_CORE, _FINE),
                self.surround(_FINE),
            )
        )
        contrast = np.minimum(core[:, 11], plate[:, 14]) - ring[:, 4]
        spread = ring[:, 8] - ring[:, 1]
        limit = clear * contrast
        good = (contrast >= _MIN_CONTRAST) & (spread <= limit)
        good &= (core[:, 17] - core[:, 7] <= limit) & (plate[:, 19] - plate[:, 11] <= limit)
        good &= np.abs(core[:, 11] - plate[:, 14]) <= _SAME_WHITE * contrast
        return np.where(good, np.maximum(contrast - 0.5 * spread, 1.0), 0.0)


def _seeds_of_level(level: Level, scale: _Scale) -> Seeds:
    padded = cv2.copyMakeBorder(level.image, *(_MARGIN_PX,) * 4, cv2.BORDER_REPLICATE)
    core = cv2.blur(padded, (scale.core_box, scale.core_box))
    places, contrast = _peaks(core, cv2.blur(padded, (3, 3)), scale)
    values, width = padded.ravel(), padded.shape[1]
    centre = core.ravel()[places]
    middle = centre - contrast // 2
    directions, stretch = _best_radius(values, width, places, middle, scale.radius)
    good = directions >= _ENOUGH_OF_FEW
    rows, columns = np.divmod(places[good], width)
    centres = np.column_stack((columns, rows)) - (_MARGIN_PX - 0.5)
    return Seeds(
        level.factor * centres - 0.5,
        level.factor * scale.radius * stretch[good],
        middle[good].astype(np.float64),
    )


def _best_radius(
    values: GreyArray, width: int, places: IndexArray, middle: GreyArray, radius: float
) -> tuple[GreyArray, FloatArray]:
    """Return in how many directions a ring is seen, at best, and the radius it is best seen at."""
    most = np.zeros(len(places), dtype=np.uint8)
    best = np.ones(len(places))
    for stretch in _STRETCHES:
        count = _ring_directions(values, width, places, middle, stretch * radius)
        best[count > most] = stretch
        most = np.maximum(most, count)
    return most, best


def _peaks(core: GreyArray, smooth: GreyArray, scale: _Scale) -> tuple[IndexArray, GreyArray]:
    """Return where a core is brightest against what is beside it in three of four directions."""
    height, width = core.shape
    m = _MARGIN_PX
    a, b, c, d = (smooth[m + y : height - m + y, m + x : width - m + x] for x, y in scale.aside)
    second = cv2.max(cv2.max(cv2.min(a, b), cv2.min(c, d)), cv2.min(cv2.max(a, b), cv2.max(c, d)))
    contrast = cv2.subtract(core[m:-m, m:-m], second)
    highest = cv2.dilate(contrast, np.ones((3, 3), np.uint8))
    peaks = cv2.compare(contrast, highest, cv2.CMP_GE)
    found = np.flatnonzero(cv2.bitwise_and(peaks, contrast) >= _MIN_CONTRAST)
    rows, columns = np.divmod(found, contrast.shape[1])
    return (rows + m) * width + columns + m, contrast.ravel()[found]


def _ring_directions(
    values: GreyArray,
    width: int,
    places: IndexArray,
    middle: GreyArray,
    radius: float,
) -> GreyArray:
    """Count the directions in which a dark ring is followed by a brighter surround."""
    found = np.zeros(len(places), dtype=np.uint8)
    near, far = (_offsets(ratio * radius, width) for ratio in _SURROUND)
    for ring, one, other in zip(_offsets(_RING * radius, width), near, far, strict=True):
        dark = values[places + ring] < middle
        found += dark & (np.maximum(values[places + one], values[places + other]) > middle)
    return found


def _offsets(radius: float, width: int) -> IndexArray:
    angles = 2.0 * np.pi / _FEW * (np.arange(_FEW) + 0.5)
    x, y = np.rint(radius * np.cos(angles)), np.rint(radius * np.sin(angles))
    return np.asarray((y * width + x).astype(np.intp))
