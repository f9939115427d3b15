"""Grey values on circles around places that may be a ring's: how dark it is, and how even."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.target.peaks import PEAK_RADIUS_PX
from kgcp.target.pyramid import Pyramid

_RATIOS = np.array((0.76, 1.15, 1.34, 0.33))  # circles that are looked at, of the ring's radius
_RING, _NEAR, _FAR, _CORE = range(4)  # the last is outside of a replica
_ROUGH = np.array((0.85, 1.1))  # radii that are tried
_FINE = np.array((0.9, 1.0, 1.1))
_TRIALS = np.outer(_ROUGH, _FINE).ravel()
_COARSER = np.array((2.0, 3.0))  # images than those that are looked at
_REACHES = np.ceil(PEAK_RADIUS_PX * _COARSER * _TRIALS.max() * _RATIOS.max()).astype(np.intp)
_DIRECTIONS = _FEW, _MANY, _ALL = 8, 16, 24  # that are looked in first, then, and at last
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 9  # hidden quarters and dots leave half of the ring
_MIN_CONTRAST = 5  # grey values
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of ring, core and surround, of the contrast
_LARGE_PX = 22.0  # radius from which there are few seeds
_SAME_WHITE = 0.8  # core and surround may differ by so much, of the contrast

_Shifts = npt.NDArray[np.uintp]  # (radii, circles, few and many and all directions)


def _sorting_network(count: int) -> IndexArray:
    """Return the pairs (n, 2) that, put in order one by one, sort so many values.

    Merge exchange (Batcher 1968; Knuth, The Art of Computer Programming 3, algorithm 5.2.2 M).
    """
    pairs = []
    largest = 1 << ((count - 1).bit_length() - 1)
    span = largest
    while span > 0:
        step, apart, residue = largest, span, 0
        while True:
            pairs += [(i, i + apart) for i in range(count - apart) if i & span == residue]
            if step == span:
                break
            step, apart, residue = step // 2, step - span, span
        span //= 2
    return np.array(pairs)


def _offsets() -> IndexArray:
    """Return columns and rows (ratios, 2, radii, circles, directions) of samples on circles."""
    angles = np.concatenate([2.0 * np.pi / n * (np.arange(n) + 0.5) for n in _DIRECTIONS])
    radii = PEAK_RADIUS_PX * np.multiply.outer(np.outer(_COARSER, _TRIALS), _RATIOS)
    places = radii[:, None, :, :, None] * np.stack((np.cos(angles), np.sin(angles)))[:, None, None]
    return np.asarray(np.floor(places + 0.5), np.intp)


_NETWORK, _OFFSETS = _sorting_network(_ALL), _offsets()


def look_around(pyramid: Pyramid, peaks: FloatArray, ends: IndexArray) -> FloatArray:
    """Tell which peaks are rings': of a ring, a core and a surround of one grey value each.

    Each is looked at in a finer image. Cheap tests come first: dark and then bright in some of
    eight directions, then in some of 16.

    Parameters
    ----------
    pyramid : Pyramid
    peaks, ends
        As `find_peaks` returns them, of the pyramid's last levels.

    Returns
    -------
    rings : (n, 4) array
        Centre and outer radius in the frame [px]; contrast in grey values, less the spread.
    """
    rings = np.empty((len(peaks), 4))
    images = pyramid.frame, pyramid.reduced, pyramid.levels
    count = _look_at_all(*images, peaks, ends, _OFFSETS, _REACHES, PEAK_RADIUS_PX, rings)
    return rings[:count]


@compiled
def _look_at_all(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    peaks: FloatArray,
    ends: IndexArray,
    offsets: IndexArray,
    reaches: IndexArray,
    peak_radius: float,
    rings: FloatArray,
) -> int:
    """Fill in what `look_around` returns, and count it.

    Where pixels are 2, 3, 4, 6, 8, 12, … of the frame's wide, images of 1, 1, 2, 2, 4, 4, … serve.
    """
    count, begin = 0, 0
    for k in range(len(ends)):
        octave, third = divmod(len(levels) - len(ends) + k, 2)
        some, found = peaks[begin : ends[k]], rings[count:]
        samples = offsets[third], reaches[third], 2.0**octave, 2.0 + third, peak_radius
        if octave == 0:
            count += _look(frame, some, *samples, found)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            count += _look(image, some, *samples, found)
        begin = ends[k]
    return count


@compiled
def _look(
    image: GreyArray,
    peaks: FloatArray,
    offsets: IndexArray,
    reach: int,
    factor: float,
    coarser: float,
    peak_radius: float,
    rings: FloatArray,
) -> int:
    """Look at the peaks of one level; near the border, at a copy of what is around.

    A pixel of `image` is `factor` pixels of the frame wide, one of the level `coarser` times that.
    """
    height, width = image.shape
    radius = factor * coarser * peak_radius
    clear = _CLEAR_LARGE if radius >= _LARGE_PX else _CLEAR
    side = 2 * reach + 1
    pixels, patch = image.reshape(-1), np.empty((side, side), np.uint8)
    shifts, patch_shifts = _shifts(offsets, width), _shifts(offsets, side)
    values = np.empty((3, _ALL), np.int64)
    count = 0
    for i in range(len(peaks)):
        x = math.floor(coarser * (peaks[i, 0] + 0.5))  # the pixel that holds the point
        y = math.floor(coarser * (peaks[i, 1] + 0.5))
        if reach <= x < width - reach and reach <= y < height - reach:
            place = y * width + x
            found = _clearest(pixels, place, shifts, peaks[i, 2], clear, values)
        else:
            _copy_around(image, x - reach, y - reach, patch)
            place = reach * side + reach
            found = _clearest(patch.reshape(-1), place, patch_shifts, peaks[i, 2], clear, values)
        if found[0] > 0.0:
            rings[count, 0] = factor * coarser * (peaks[i, 0] + 0.5) - 0.5
            rings[count, 1] = factor * coarser * (peaks[i, 1] + 0.5) - 0.5
            rings[count, 2], rings[count, 3] = radius * _TRIALS[found[1]], found[0]
            count += 1
    return count


@compiled
def _shifts(offsets: IndexArray, width: int) -> _Shifts:
    """Return how many pixels further samples on circles are, in images of a width.

    Those that are nearer have wrapped about, as their sums with a pixel's place do.
    """
    shifts: _Shifts = (offsets[1] * width + offsets[0]).view(np.uintp)
    return shifts


@compiled
def _copy_around(image: GreyArray, left: int, top: int, patch: GreyArray) -> None:
    """Copy some rows and columns; beyond its border the image repeats its last pixels."""
    height, width = image.shape
    side = len(patch)
    first, last = min(max(-left, 0), side), min(max(width - left, 0), side)
    for i in range(side):
        row = image[min(max(top + i, 0), height - 1)]
        patch[i, :first] = row[0]
        patch[i, last:] = row[width - 1]
        for j in range(first, last):
            patch[i, j] = row[left + j]


@compiled
def _clearest(
    pixels: GreyArray, place: int, shifts: _Shifts, middle: float, clear: float, values: IndexArray
) -> tuple[float, int]:
    """Return how clear the clearest ring about a pixel is, and the number of its radius."""
    at = np.uintp(place)
    dark, bright = math.ceil(middle), math.floor(middle)
    most, best, clearest = _ENOUGH_OF_FEW - 1, 0, 0.0
    first = -1
    for k in range(0, len(_TRIALS), len(_FINE)):
        count = _count(pixels, at, shifts, k + 1, 0, _FEW, dark, bright)
        if count > most:
            most, first = count, k
    if first < 0:
        return clearest, best
    for k in range(first, first + len(_FINE)):
        count = _count(pixels, at, shifts, k, _FEW, _MANY, dark, bright)
        if count >= _ENOUGH_OF_MANY:
            clearness = _clearness(pixels, at, shifts, k, clear, values)
            if clearness > clearest:
                clearest, best = clearness, k
    return clearest, best


@compiled
def _count(
    pixels: GreyArray,
    at: np.uintp,
    shifts: _Shifts,
    trial: int,
    first: int,
    directions: int,
    dark: int,
    bright: int,
) -> int:
    """Count the directions in which a dark ring is followed by a brighter surround."""
    count = 0
    for k in range(first, first + directions):
        is_dark = pixels[at + shifts[trial, _RING, k]] < dark
        is_near = pixels[at + shifts[trial, _NEAR, k]] > bright
        is_far = pixels[at + shifts[trial, _FAR, k]] > bright
        count += is_dark & (is_near | is_far)
    return count


@compiled
def _clearness(
    pixels: GreyArray,
    at: np.uintp,
    shifts: _Shifts,
    trial: int,
    clear: float,
    values: IndexArray,
) -> float:
    """Return the contrast, less the ring's spread; 0 if anything is spread too much."""
    ring, core, plate = values[0], values[1], values[2]
    first = _FEW + _MANY
    for k in range(_ALL):
        ring[k] = pixels[at + shifts[trial, _RING, first + k]]
        core[k] = pixels[at + shifts[trial, _CORE, first + k]]
    _sort(ring)
    _sort(core)
    contrast, spread = core[11] - ring[4], ring[8] - ring[1]
    limit = clear * contrast
    if contrast < _MIN_CONTRAST or spread > limit or core[17] - core[7] > limit:
        return 0.0
    for k in range(_ALL):
        near = pixels[at + shifts[trial, _NEAR, first + k]]
        plate[k] = max(near, pixels[at + shifts[trial, _FAR, first + k]])
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
    """Sort as many values as there are directions, in place."""
    for k in range(len(_NETWORK)):
        i, j = _NETWORK[k, 0], _NETWORK[k, 1]
        one, other = values[i], values[j]
        values[i], values[j] = min(one, other), max(one, other)
