"""Grey values on circles around places that may be a ring's: how dark it is, and how even."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.pyramid import Pyramid
from kgcp.measurement.search.ring_filter import PEAK_RADIUS_PX

_RATIOS = np.array((0.76, 1.15, 1.34, 0.33))  # circles that are looked at, of the ring's radius
_RING, _NEAR, _FAR, _CORE = range(4)  # the last is outside of a replica
_ROUGH = np.array((0.85, 1.1))  # radii that are tried
_FINE = np.array((0.9, 1.0, 1.1))
_TRIALS = np.outer(_ROUGH, _FINE).ravel()
_COARSER = np.array((2.0, 3.0))  # images than those that are looked at
_FEW, _MANY, _ALL = 8, 16, 24  # directions that are looked in first, then, and at last
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 9  # hidden quarters and dots leave half of the ring
_MIN_CONTRAST = 5  # grey values
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of ring, core and surround, of the contrast
_LARGE_PX = 22.0  # radius from which there are few seeds
_SAME_WHITE = 0.8  # core and surround may differ by so much, of the contrast

_Shifts = npt.NDArray[np.uintp]  # (radii, circles, directions)


def _offsets(trials: FloatArray, circles: int, *counts: int) -> IndexArray:
    """Return x and y of samples on circles: (ratios of pixels, 2, radii, circles, directions)."""
    angles = np.concatenate([2.0 * np.pi / n * (np.arange(n) + 0.5) for n in counts])
    ways = np.stack((np.cos(angles), np.sin(angles)))[:, None, None]
    radii = PEAK_RADIUS_PX * np.multiply.outer(np.outer(_COARSER, trials), _RATIOS[:circles])
    return np.asarray(np.floor(radii[:, None, :, :, None] * ways + 0.5), np.intp)


_FIRST = _offsets(_TRIALS[1 :: len(_FINE)], 3, _FEW)
_REST = _offsets(_TRIALS, 4, _MANY, _ALL)


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
    count = _look_at_all(*images, peaks, ends, _FIRST, _REST, PEAK_RADIUS_PX, rings)
    return rings[:count]


@compiled
def _look_at_all(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    peaks: FloatArray,
    ends: IndexArray,
    first: IndexArray,
    rest: IndexArray,
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
        samples = first[third], rest[third], 2.0**octave, 2.0 + third, peak_radius
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
    first: IndexArray,
    rest: IndexArray,
    factor: float,
    coarser: float,
    peak_radius: float,
    rings: FloatArray,
) -> int:
    """Look at the peaks of one level.

    A pixel of `image` is `factor` pixels of the frame wide, one of the level `coarser` times that.
    """
    height, width = image.shape
    pixels, reach = image.reshape(-1), rest.max()
    radius = factor * coarser * peak_radius
    clear = _CLEAR_LARGE if radius >= _LARGE_PX else _CLEAR
    first_shifts, rest_shifts = _shifts(first, width), _shifts(rest, width)
    first_places, rest_places = np.empty_like(first_shifts), np.empty_like(rest_shifts)
    values = np.empty((3, _ALL), np.uint8)
    count = 0
    for i in range(len(peaks)):
        x = math.floor(coarser * (peaks[i, 0] + 0.5))  # the pixel that holds the point
        y = math.floor(coarser * (peaks[i, 1] + 0.5))
        dark, bright = math.ceil(peaks[i, 2]), math.floor(peaks[i, 2])
        inside = reach <= x < width - reach and reach <= y < height - reach
        at = np.uintp(y * width + x if inside else 0)
        if not inside:
            _keep_inside(first, x, y, width, height, first_places)
        samples = first_shifts if inside else first_places
        rough = _roughly(pixels, at, samples, dark, bright)
        if rough < 0:
            continue
        if not inside:
            _keep_inside(rest, x, y, width, height, rest_places)
        samples = rest_shifts if inside else rest_places
        found = _clearest(pixels, at, samples, rough, dark, bright, clear, values)
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
def _keep_inside(
    offsets: IndexArray, x: int, y: int, width: int, height: int, places: _Shifts
) -> None:
    """Fill in where samples are; those beyond the image's border move to its last pixels."""
    columns, rows, out = offsets[0].reshape(-1), offsets[1].reshape(-1), places.reshape(-1)
    for k in range(len(out)):
        column = min(max(x + columns[k], 0), width - 1)
        out[k] = min(max(y + rows[k], 0), height - 1) * width + column


@inlined
def _roughly(pixels: GreyArray, at: np.uintp, shifts: _Shifts, dark: int, bright: int) -> int:
    """Return the number of the rough radius at which there may be a ring, or -1."""
    most, best = _ENOUGH_OF_FEW - 1, -1
    for trial in range(len(_ROUGH)):
        count = _count(pixels, at, shifts, trial, _FEW, dark, bright)
        if count > most:
            most, best = count, trial
    return best


@compiled
def _clearest(
    pixels: GreyArray,
    at: np.uintp,
    shifts: _Shifts,
    rough: int,
    dark: int,
    bright: int,
    clear: float,
    values: GreyArray,
) -> tuple[float, int]:
    """Return how clear the clearest ring of about a radius is, and the number of its radius."""
    best, clearest = 0, 0.0
    for k in range(rough * len(_FINE), (rough + 1) * len(_FINE)):
        if _count(pixels, at, shifts, k, _MANY, dark, bright) >= _ENOUGH_OF_MANY:
            clearness = _clearness(pixels, at, shifts, k, clear, values)
            if clearness > clearest:
                clearest, best = clearness, k
    return clearest, best


@inlined
def _count(
    pixels: GreyArray,
    at: np.uintp,
    shifts: _Shifts,
    trial: int,
    directions: int,
    dark: int,
    bright: int,
) -> int:
    """Count the directions in which a dark ring is followed by a brighter surround."""
    count = 0
    for k in range(directions):
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
    values: GreyArray,
) -> float:
    """Return the contrast, less the ring's spread; 0 if anything is spread too much."""
    for k in range(_ALL):
        values[0, k] = pixels[at + shifts[trial, _RING, _MANY + k]]
        values[1, k] = pixels[at + shifts[trial, _CORE, _MANY + k]]
    darkest, ring, ring_bright = _ranked(values[0], 1, 4, 8)
    core_dark, core, core_bright = _ranked(values[1], 7, 11, 17)
    contrast, spread = core - ring, ring_bright - darkest
    limit = clear * contrast
    if contrast < _MIN_CONTRAST or spread > limit or core_bright - core_dark > limit:
        return 0.0
    for k in range(_ALL):
        near = pixels[at + shifts[trial, _NEAR, _MANY + k]]
        values[2, k] = max(near, pixels[at + shifts[trial, _FAR, _MANY + k]])
    plate_dark, plate, plate_bright = _ranked(values[2], 11, 14, 19)
    difference = abs(core - plate)
    contrast = min(core, plate) - ring
    limit = clear * contrast
    if contrast < _MIN_CONTRAST or spread > limit or core_bright - core_dark > limit:
        return 0.0
    if plate_bright - plate_dark > limit or difference > _SAME_WHITE * contrast:
        return 0.0
    return float(max(contrast - 0.5 * spread, 1.0))


@compiled
def _ranked(
    values: GreyArray, low: int, middle: int, high: int
) -> tuple[np.int64, np.int64, np.int64]:
    """Return three values of ascending ranks: the largest that so many or less are smaller than."""
    one, two, three = np.uint8(0), np.uint8(0), np.uint8(0)
    for i in range(_ALL):
        value, smaller = values[i], np.uint8(0)
        for k in range(_ALL):
            smaller += np.uint8(values[k] < value)
        one = max(one, value if smaller <= low else np.uint8(0))
        two = max(two, value if smaller <= middle else np.uint8(0))
        three = max(three, value if smaller <= high else np.uint8(0))
    return np.int64(one), np.int64(two), np.int64(three)
