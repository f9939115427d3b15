"""Grey values on circles around places that may be a ring's: how dark it is, and how even."""

from __future__ import annotations

import math

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray

_RATIOS = np.array((0.76, 1.15, 1.34, 0.33))  # circles that are looked at, of the ring's radius
_RING, _NEAR, _FAR, _CORE = range(4)  # the last is outside of a replica
_ROUGH = np.array((0.85, 1.1))  # radii that are tried
_FINE = np.array((0.9, 1.0, 1.1))
_FEW, _MANY, _ALL = 8, 16, 24  # directions
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 9  # hidden quarters and dots leave half of the ring
_MIN_CONTRAST = 5  # grey values
_SAME_WHITE = 0.8  # core and surround may differ by so much, of the contrast


@compiled
def look_around(
    image: GreyArray,
    centres: FloatArray,
    middles: FloatArray,
    radius: float,
    clear: float,
    stretches: FloatArray,
    clearness: FloatArray,
) -> None:
    """Tell how clear rings are whose ring, core and surround are each of one grey value.

    Cheap tests come first: dark and then bright in some of eight directions, then in some of 16.

    Parameters
    ----------
    image : (height, width) array of uint8
    centres : (n, 2) array
        Of the rings [px].
    middles : (n,) array
        Grey values between those of core and ring.
    radius : float
        Of the outer circles [px].
    clear : float
        By how much ring, core and surround may be spread each, of the contrast.
    stretches, clearness : (n,) array
        Filled in: by how much the radius is larger; contrast in grey values less spread, 0 where
        there is no ring.
    """
    trials = (_ROUGH.reshape(-1, 1) * _FINE).ravel()
    few, many = _offsets(radius * _ROUGH, _FEW), _offsets(radius * trials, _MANY)
    every = _offsets(radius * trials, _ALL)
    values = np.empty((3, _ALL), np.int64)
    for i in range(len(centres)):
        x, y = math.floor(centres[i, 0] + 0.5), math.floor(centres[i, 1] + 0.5)
        clearness[i] = 0.0
        most, rough = 0, 0
        for k in range(len(_ROUGH)):
            count = _count(image, x, y, few[k], middles[i])
            if count > most:
                most, rough = count, k
        if most < _ENOUGH_OF_FEW:
            continue
        for k in range(len(_FINE) * rough, len(_FINE) * (rough + 1)):
            if _count(image, x, y, many[k], middles[i]) >= _ENOUGH_OF_MANY:
                found = _clearness(image, x, y, every[k], clear, values)
                if found > clearness[i]:
                    clearness[i], stretches[i] = found, trials[k]


@compiled
def _offsets(radii: FloatArray, count: int) -> IndexArray:
    """Return pixels (radii, circles, directions, 2) on circles about a pixel."""
    offsets = np.empty((len(radii), len(_RATIOS), count, 2), np.int64)
    for i in range(len(radii)):
        for j in range(len(_RATIOS)):
            for k in range(count):
                angle, length = 2.0 * math.pi / count * (k + 0.5), radii[i] * _RATIOS[j]
                offsets[i, j, k, 0] = math.floor(length * math.cos(angle) + 0.5)
                offsets[i, j, k, 1] = math.floor(length * math.sin(angle) + 0.5)
    return offsets


@compiled
def _value(image: GreyArray, x: int, y: int, offset: IndexArray) -> int:
    """Return a pixel's value; beyond its border the image repeats its last pixels."""
    column = min(max(x + offset[0], 0), image.shape[1] - 1)
    row = min(max(y + offset[1], 0), image.shape[0] - 1)
    return int(image[row, column])


@compiled
def _count(image: GreyArray, x: int, y: int, offsets: IndexArray, middle: float) -> int:
    """Count the directions in which a dark ring is followed by a brighter surround."""
    count = 0
    for k in range(offsets.shape[1]):
        is_dark = _value(image, x, y, offsets[_RING, k]) < middle
        is_near = _value(image, x, y, offsets[_NEAR, k]) > middle
        is_far = _value(image, x, y, offsets[_FAR, k]) > middle
        count += is_dark & (is_near | is_far)
    return count


@compiled
def _clearness(
    image: GreyArray,
    x: int,
    y: int,
    offsets: IndexArray,
    clear: float,
    values: IndexArray,
) -> float:
    """Return the contrast, less the ring's spread; 0 if anything is spread too much."""
    ring, core, plate = values[0], values[1], values[2]
    for k in range(offsets.shape[1]):
        ring[k] = _value(image, x, y, offsets[_RING, k])
        core[k] = _value(image, x, y, offsets[_CORE, k])
    _sort(ring)
    _sort(core)
    contrast, spread = core[11] - ring[4], ring[8] - ring[1]
    limit = clear * contrast
    if contrast < _MIN_CONTRAST or spread > limit or core[17] - core[7] > limit:
        return 0.0
    for k in range(offsets.shape[1]):
        near = _value(image, x, y, offsets[_NEAR, k])
        plate[k] = max(near, _value(image, x, y, offsets[_FAR, k]))
    _sort(plate)
    difference = abs(core[11] - plate[14])
    contrast = min(core[11], plate[14]) - ring[4]
    limit = clear * contrast
    if contrast < _MIN_CONTRAST or spread > limit or core[17] - core[7] > limit:
        return 0.0
    if plate[19] - plate[11] > limit or difference > _SAME_WHITE * contrast:
        return 0.0
    return float(max(contrast - 0.5 * spread, 1.0))


@compiled
def _sort(values: IndexArray) -> None:
    """Sort a few values in place, by insertion."""
    for i in range(1, len(values)):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
