"""Grey values on circles around places that may be a ring's: how dark it is, and how even.

The ring filter also answers to much else. Here few samples per place decide, dark ones on the ring
and bright ones around it, in more and more directions; most places are dropped after eight. At last
the samples on the ring, 24, must be of one grey value, and those on core and surround vary no more
than shade makes them. Order statistics measure that, not means: dots brighten and something in the
way may hide a part of any circle, which moves the mean and the largest values, but not those of
lower rank. docs/method.md, "Ring check", has the ranks.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined, prefetch
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.pyramid import Pyramid
from kgcp.measurement.search.ring_filter import PEAK_RADIUS_PX

# Tuning of the check. The benchmark is `benchmarks.search.hard_frames`; docs/method.md, "Constants
# of the search", has what it finds with other values. Radii are in units of the outer one.
_RATIOS = np.array((0.76, 1.15, 1.34, 0.33))  # of circles that are sampled
_RING, _NEAR, _FAR, _CORE = range(4)  # the core's circle is outside of a replica
_ROUGH = np.array((0.85, 1.1))  # radii that are tried, of the one that the filter answers to most
_FINE = np.array((0.9, 1.0, 1.1))  # and of each of those
_FEW, _MANY, _ALL = 8, 16, 24  # directions that are sampled first, then, and at last
_ENOUGH_OF_FEW, _ENOUGH_OF_MANY = 4, 9  # a hidden quarter and dots leave half
_MIN_CONTRAST = 5  # grey values: less is noise
_CLEAR, _CLEAR_LARGE = 0.5, 0.8  # spread of the ring, of the contrast
_LARGE_PX = 22.0  # radius from which there are so few places that a wider spread costs nothing
# A surround so many times as bright as the ring beside it counts as bright, even if shade makes it
# darker than the filter's mean in light.
_BRIGHTER = 2
# Spread of core and of surround, and their difference, of the contrast in shade: in a linear image
# half in shade that takes away half of the light, they are as much as the contrast. They are more
# in deeper shade, if it falls on both alike: the spread of what they differ by, over half of the
# directions, of the ring's depth.
_UNEVEN, _MOST_UNEVEN = 1.2, 4.0
_MOST_APART = 0.6
# Order statistics of 24 samples, from 0. Up to a third of the ring may be dots: its typical grey
# value is of rank 4, and what is even about it lies between the ranks 1 and 8. Of core and surround
# a third may be dark, hidden or beyond the plate, and only bright ranks tell.
_RING_RANKS = 1, 4, 8
_CORE_RANKS = 7, 11, 17
_PLATE_RANKS = 11, 14, 19

_TRIALS = np.outer(_ROUGH, _FINE).ravel()
_COARSER = np.array((2.0, 3.0))  # pixels of the filtered images, in pixels of the sampled ones

_AHEAD = 6  # peaks whose pixels are loaded beforehand; from 4 to 24, times are the same

_Addresses = npt.NDArray[np.uintp]  # (radii, circles, directions)


def _offsets(trials: FloatArray, circles: int, *counts: int) -> IndexArray:
    """Return x and y of samples on circles: (ratios of pixels, 2, radii, circles, directions)."""
    angles = np.concatenate([2.0 * np.pi / n * (np.arange(n) + 0.5) for n in counts])
    unit = np.stack((np.cos(angles), np.sin(angles)))[:, None, None]
    radii = PEAK_RADIUS_PX * np.multiply.outer(np.outer(_COARSER, trials), _RATIOS[:circles])
    return np.asarray(np.floor(radii[:, None, :, :, None] * unit + 0.5), np.intp)


_ROUGH_OFFSETS = _offsets(_TRIALS[1 :: len(_FINE)], 3, _FEW)
_FINE_OFFSETS = _offsets(_TRIALS, 4, _MANY, _ALL)


def check_peaks(pyramid: Pyramid, peaks: FloatArray, ends: IndexArray) -> FloatArray:
    """Return the rings among the peaks: ring, core and surround are of one grey value each.

    Each is sampled in an image that is two or three times finer than the one it was found in.
    Cheap tests come first: dark and then bright in some of eight directions, then in some of 16.

    Parameters
    ----------
    peaks, ends
        As `find_peaks` returns them, of the pyramid's last levels.

    Returns
    -------
    rings : (n, 4) array
        Centre and outer radius in the frame [px]; contrast in grey values, less the spread.
    """
    rings = np.empty((len(peaks), 4))
    images = pyramid.frame, pyramid.reduced, pyramid.levels
    # What depends on another module's constants is passed: compiled code would keep old values.
    count = _check_all(*images, peaks, ends, _ROUGH_OFFSETS, _FINE_OFFSETS, PEAK_RADIUS_PX, rings)
    return rings[:count]


@compiled
def _check_all(
    frame: GreyArray,
    reduced: GreyArray,
    levels: IndexArray,
    peaks: FloatArray,
    ends: IndexArray,
    rough_offsets: IndexArray,
    fine_offsets: IndexArray,
    peak_radius: float,
    rings: FloatArray,
) -> int:
    """Fill in what `check_peaks` returns, and count it.

    Where pixels are 2, 3, 4, 6, 8, 12, … of the frame's wide, images of 1, 1, 2, 2, 4, 4, … serve.
    """
    count, begin = 0, 0
    for k in range(len(ends)):
        octave, third = divmod(len(levels) - len(ends) + k, 2)
        rough, fine = rough_offsets[third], fine_offsets[third]
        factor, coarser = 2.0**octave, 2.0 + third
        part, out = peaks[begin : ends[k]], rings[count:]
        if octave == 0:  # apart, since the frame may be a read-only array: another type
            count += _check_level(frame, part, rough, fine, factor, coarser, peak_radius, out)
        else:
            at = levels[2 * octave - 2]
            image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
            count += _check_level(image, part, rough, fine, factor, coarser, peak_radius, out)
        begin = ends[k]
    return count


@compiled
def _check_level(
    image: GreyArray,
    peaks: FloatArray,
    rough_offsets: IndexArray,
    fine_offsets: IndexArray,
    factor: float,
    coarser: float,
    peak_radius: float,
    rings: FloatArray,
) -> int:
    """Check the peaks of one level.

    A pixel of `image` is `factor` pixels of the frame wide, one of the level `coarser` times that.
    Samples are read by their distance from the place in the flattened image; only next to the
    border their addresses are worked out one by one. Large images do not fit into the cache: rows
    around later peaks are loaded beforehand, which halves the time from 12 Mpx on.
    """
    height, width = image.shape
    pixels, reach = image.reshape(-1), fine_offsets.max()
    radius = factor * coarser * peak_radius
    clear = _CLEAR_LARGE if radius >= _LARGE_PX else _CLEAR
    rough_steps, fine_steps = _steps(rough_offsets, width), _steps(fine_offsets, width)
    rough_places, fine_places = np.empty_like(rough_steps), np.empty_like(fine_steps)
    values = np.empty((3, _ALL), np.uint8)
    count = 0
    for i in range(len(peaks)):
        if i + _AHEAD < len(peaks):
            x = math.floor(coarser * (peaks[i + _AHEAD, 0] + 0.5))
            y = math.floor(coarser * (peaks[i + _AHEAD, 1] + 0.5))
            for row in range(y - reach, y + reach + 1):  # a line of the cache is wider than a peak
                prefetch(pixels, row * width + x - reach)
                prefetch(pixels, row * width + x + reach)
        x = math.floor(coarser * (peaks[i, 0] + 0.5))  # the pixel that holds the point
        y = math.floor(coarser * (peaks[i, 1] + 0.5))
        dark, bright = math.ceil(peaks[i, 2]), math.floor(peaks[i, 2])
        inside = reach <= x < width - reach and reach <= y < height - reach
        at = np.uintp(y * width + x if inside else 0)
        if not inside:
            _keep_inside(rough_offsets, x, y, width, height, rough_places)
        samples = rough_steps if inside else rough_places
        rough = _rough_radius(pixels, at, samples, dark, bright)
        if rough < 0:
            continue
        if not inside:
            _keep_inside(fine_offsets, x, y, width, height, fine_places)
        samples = fine_steps if inside else fine_places
        clearness, trial = _clearest(pixels, at, samples, rough, dark, bright, clear, values)
        if clearness > 0.0:
            rings[count, 0] = factor * coarser * (peaks[i, 0] + 0.5) - 0.5
            rings[count, 1] = factor * coarser * (peaks[i, 1] + 0.5) - 0.5
            rings[count, 2], rings[count, 3] = radius * _TRIALS[trial], clearness
            count += 1
    return count


@compiled
def _steps(offsets: IndexArray, width: int) -> _Addresses:
    """Return how many pixels further samples are than their place, in an image of this width.

    Steps back are unsigned numbers that wrap around, as their sums with the place's address do.
    """
    steps: _Addresses = (offsets[1] * width + offsets[0]).view(np.uintp)
    return steps


@compiled
def _keep_inside(
    offsets: IndexArray, x: int, y: int, width: int, height: int, places: _Addresses
) -> None:
    """Fill in where samples are; those beyond the image's border move to its last pixels."""
    columns, rows, out = offsets[0].reshape(-1), offsets[1].reshape(-1), places.reshape(-1)
    for k in range(len(out)):
        column = min(max(x + columns[k], 0), width - 1)
        out[k] = min(max(y + rows[k], 0), height - 1) * width + column


@inlined
def _rough_radius(
    pixels: GreyArray, at: np.uintp, steps: _Addresses, dark: int, bright: int
) -> int:
    """Return the number of the rough radius at which there may be a ring, or -1."""
    most, best = _ENOUGH_OF_FEW - 1, -1
    for trial in range(len(_ROUGH)):
        count = _count_directions(pixels, at, steps, trial, _FEW, dark, bright)
        if count > most:
            most, best = count, trial
    return best


@compiled
def _clearest(
    pixels: GreyArray,
    at: np.uintp,
    steps: _Addresses,
    rough: int,
    dark: int,
    bright: int,
    clear: float,
    values: GreyArray,
) -> tuple[float, int]:
    """Return how clear the clearest ring of about a radius is, and the number of its radius."""
    best, clearest = 0, 0.0
    for k in range(rough * len(_FINE), (rough + 1) * len(_FINE)):
        if _count_directions(pixels, at, steps, k, _MANY, dark, bright) >= _ENOUGH_OF_MANY:
            clearness = _clearness(pixels, at, steps, k, clear, values)
            if clearness > clearest:
                clearest, best = clearness, k
    return clearest, best


@inlined
def _count_directions(
    pixels: GreyArray,
    at: np.uintp,
    steps: _Addresses,
    trial: int,
    directions: int,
    dark: int,
    bright: int,
) -> int:
    """Count the directions in which a dark ring is followed by a brighter surround.

    In even light a grey value lies between them in all directions; in shade, each direction has a
    light of its own. The surround may be seen on the nearer circle alone, if the plate's margin is
    narrow, or on the farther one alone, if blur brings the ring's edge to the nearer.
    """
    count = 0
    for k in range(directions):
        ring = np.int64(pixels[at + steps[trial, _RING, k]])
        near = pixels[at + steps[trial, _NEAR, k]]
        surround = np.int64(max(near, pixels[at + steps[trial, _FAR, k]]))
        in_even_light = (ring < dark) & (surround > bright)
        in_shade = surround > _BRIGHTER * ring + _MIN_CONTRAST
        count += int(in_even_light | in_shade)
    return count


@compiled
def _clearness(
    pixels: GreyArray,
    at: np.uintp,
    steps: _Addresses,
    trial: int,
    clear: float,
    values: GreyArray,
) -> float:
    """Return the contrast, less the ring's spread; 0 if anything is spread too much."""
    for k in range(_ALL):
        values[0, k] = pixels[at + steps[trial, _RING, _MANY + k]]
        values[1, k] = pixels[at + steps[trial, _CORE, _MANY + k]]
    ring_dark, ring, ring_bright = _order_statistics(values[0], _RING_RANKS)
    core_dark, core, core_bright = _order_statistics(values[1], _CORE_RANKS)
    contrast, spread = core - ring, ring_bright - ring_dark
    # Most fail by ring and core alone: the surround is sampled only where they do not.
    if contrast < _MIN_CONTRAST or spread > clear * contrast:
        return 0.0
    if core_bright - core_dark > _MOST_UNEVEN * contrast:
        return 0.0
    for k in range(_ALL):
        near = pixels[at + steps[trial, _NEAR, _MANY + k]]
        values[2, k] = max(near, pixels[at + steps[trial, _FAR, _MANY + k]])
    plate_dark, plate, plate_bright = _order_statistics(values[2], _PLATE_RANKS)
    contrast = min(core, plate) - ring
    if contrast < _MIN_CONTRAST or spread > clear * contrast:
        return 0.0
    uneven = max(core_bright - core_dark, plate_bright - plate_dark, abs(core - plate))
    if uneven > _MOST_UNEVEN * contrast:
        return 0.0
    if uneven > _UNEVEN * contrast and not _are_lit_alike(values):
        return 0.0
    return float(max(contrast - 0.5 * spread, 1.0))


@compiled
def _are_lit_alike(values: GreyArray) -> bool:
    """Return whether core and surround differ by the same in half of the directions, as in shade.

    `values` (3, 24) are the samples of ring, core and surround.
    """
    differences, depths = np.empty(_ALL, np.int16), np.empty(_ALL, np.int16)
    for k in range(_ALL):
        core, surround = np.int16(values[1, k]), np.int16(values[2, k])
        differences[k] = core - surround
        depths[k] = min(core, surround) - np.int16(values[0, k])
    depth = np.int16(0)
    for k in range(_ALL):
        smaller = np.uint8(0)
        for j in range(_ALL):
            smaller += np.uint8(depths[j] < depths[k])
        depth = max(depth, depths[k] if smaller <= 2 * _ALL // 3 else np.int16(0))
    apart = np.int16(math.ceil(1 + _MOST_APART * depth))  # 1: rounding
    for k in range(_ALL):
        alike = np.uint8(0)
        for j in range(_ALL):
            off = np.int16(differences[j] - differences[k])
            alike += np.uint8((off >= 0) & (off < apart))
        if alike > _ALL // 2:
            return True
    return False


@compiled
def _order_statistics(
    values: GreyArray, ranks: tuple[int, int, int]
) -> tuple[np.int64, np.int64, np.int64]:
    """Return the values of three ascending ranks, from 0, without sorting.

    The value of rank r is the largest that at most r others are less than. 24 comparisons fit into
    one vector of bytes, so that all are faster than a sort.
    """
    low, middle, high = np.uint8(0), np.uint8(0), np.uint8(0)
    for i in range(_ALL):
        value, smaller = values[i], np.uint8(0)
        for k in range(_ALL):
            smaller += np.uint8(values[k] < value)
        low = max(low, value if smaller <= ranks[0] else np.uint8(0))
        middle = max(middle, value if smaller <= ranks[1] else np.uint8(0))
        high = max(high, value if smaller <= ranks[2] else np.uint8(0))
    return np.int64(low), np.int64(middle), np.int64(high)
