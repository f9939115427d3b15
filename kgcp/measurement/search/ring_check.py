"""The ring check: tests of the filter's peaks by a few samples on concentric circles.

The ring filter responds to much besides rings. The check first tests whether samples on the ring
are dark and those around it bright, in eight directions and then in 16; most peaks are dropped
after eight. Finally 24 samples per circle are compared: those on the ring must be nearly equal, and
those on core and surround must not vary more than shade explains.

Order statistics are used instead of means. Dots brighten parts of the ring, and objects may hide a
part of any circle. That changes means and largest values, but not values of lower rank.
docs/method/search.md, "Ring check", lists the ranks.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined, prefetch
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.measurement.search.pyramid import Pyramid
from kgcp.measurement.search.ring_filter import PEAK_RADIUS_PX

# Tuning of the check. The benchmark is `benchmarks.search.hard_frames`; docs/method/search.md,
# "Constants of the search", has its results with other values.
# The sampled circles: their numbers, and their radii relative to the outer one. The surround is
# sampled on a near and on a far circle. The circle of the core lies outside a replica.
_RATIOS = np.array((0.76, 1.15, 1.34, 0.33))
_RING, _NEAR, _FAR, _CORE = range(4)
# Outer radii that are tried, relative to the radius that the filter responds to most: rough ones,
# and finer steps around each of them.
_ROUGH = np.array((0.85, 1.1))
_FINE = np.array((0.9, 1.0, 1.1))
_FEW, _MANY, _ALL = 8, 16, 24  # directions of the first, second and final test
_MIN_OF_FEW, _MIN_OF_MANY = 4, 9  # directions that must pass: a hidden quarter and dots leave half
_MIN_CONTRAST = 5  # grey values; less is noise
# Largest spread of the ring, relative to the contrast: in general, and for rings from `_LARGE_PX`
# on. There are so few peaks of this size that the wider limit costs nothing.
_MAX_RING_SPREAD, _MAX_LARGE_RING_SPREAD = 0.5, 0.8
_LARGE_PX = 22.0
# A surround counts as bright if it is this many times as bright as the ring in the same direction.
# So it is recognised in shade, where it may be darker than the filter's mean.
_SHADE_RATIO = 2
# Largest unevenness, relative to the contrast in shade: the largest of the spreads of core and
# surround and of their difference. In a linear image, half of it in shade that takes half of the
# light, the unevenness is about as large as the contrast. In deeper shade it is larger. The second
# limit holds if the shade falls on core and surround alike: over half of the directions, their
# difference may vary by at most `_MAX_DIFFERENCE_SPREAD` of the ring's depth.
_MAX_UNEVENNESS, _MAX_SHADE_UNEVENNESS = 1.2, 4.0
_MAX_DIFFERENCE_SPREAD = 0.6
# Ranks of 24 samples, counted from 0 at the darkest: low, middle and high. The middle one is the
# circle's grey value, the difference of the others its spread. Up to a third of the ring may be
# dots, hence low ranks. Of core and surround, a third may be dark, hidden or beyond the plate,
# hence high ranks.
_RING_RANKS = 1, 4, 8
_CORE_RANKS = 7, 11, 17
_PLATE_RANKS = 11, 14, 19

_TRIALS = np.outer(_ROUGH, _FINE).ravel()
_COARSER = np.array((2.0, 3.0))  # width of filtered pixels, in pixels of the image that is sampled

_PREFETCH_AHEAD = 6  # peaks whose pixels are prefetched; 4 to 24 take the same time

_Addresses = npt.NDArray[np.uintp]  # (radii, circles, directions)


def _offsets(trials: FloatArray, circles: int, *counts: int) -> IndexArray:
    """Return x and y of samples: (ratios of pixel widths, 2, radii, circles, directions)."""
    angles = np.concatenate([2.0 * np.pi / n * (np.arange(n) + 0.5) for n in counts])
    unit = np.stack((np.cos(angles), np.sin(angles)))[:, None, None]
    radii = PEAK_RADIUS_PX * np.multiply.outer(np.outer(_COARSER, trials), _RATIOS[:circles])
    return np.asarray(np.floor(radii[:, None, :, :, None] * unit + 0.5), np.intp)


_ROUGH_OFFSETS = _offsets(_TRIALS[1 :: len(_FINE)], 3, _FEW)
_FINE_OFFSETS = _offsets(_TRIALS, 4, _MANY, _ALL)


def check_peaks(pyramid: Pyramid, peaks: FloatArray, ends: IndexArray) -> FloatArray:
    """Return the rings among the peaks.

    Each peak is sampled in an image that is two or three times finer than the one it was found in.
    The cheapest tests come first: dark then bright in enough of eight directions, then of 16, then
    the order statistics of 24.

    Parameters
    ----------
    peaks, ends
        Results of `find_peaks` for the last levels of the pyramid.

    Returns
    -------
    rings : (n, 4) array
        Centre and outer radius in the frame [px]; clearness: the contrast minus half of the ring's
        spread, in grey values.
    """
    rings = np.empty((len(peaks), 4))
    images = pyramid.frame, pyramid.reduced, pyramid.levels
    # Values from another module's constants are passed, because the cache of compiled code does not
    # notice their changes.
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
    """Fill in the result of `check_peaks`, and return the number of rings.

    Peaks of levels whose pixels are 2, 3, 4, 6, 8, 12, … frame pixels wide are sampled in images
    with pixels of 1, 1, 2, 2, 4, 4, …
    """
    count, begin = 0, 0
    for k in range(len(ends)):
        octave, third = divmod(len(levels) - len(ends) + k, 2)
        rough, fine = rough_offsets[third], fine_offsets[third]
        factor, coarser = 2.0**octave, 2.0 + third
        part, out = peaks[begin : ends[k]], rings[count:]
        if octave == 0:  # separate: the frame may be read-only, which is another type for numba
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
    """Check the peaks of one level; fill in the rings and return their number.

    A pixel of `image` is `factor` frame pixels wide, and one of the level is `coarser` times that.
    Samples are addressed by constant steps from the peak in the flattened image; only near the
    border are their addresses computed one by one. Large images do not fit into the cache.
    Therefore the rows around later peaks are prefetched, which halves the time from 12 Mpx on.
    """
    height, width = image.shape
    pixels, reach = image.reshape(-1), fine_offsets.max()
    radius = factor * coarser * peak_radius
    max_spread = _MAX_LARGE_RING_SPREAD if radius >= _LARGE_PX else _MAX_RING_SPREAD
    rough_steps, fine_steps = _steps(rough_offsets, width), _steps(fine_offsets, width)
    rough_places, fine_places = np.empty_like(rough_steps), np.empty_like(fine_steps)
    values = np.empty((3, _ALL), np.uint8)
    count = 0
    for i in range(len(peaks)):
        if i + _PREFETCH_AHEAD < len(peaks):
            x = math.floor(coarser * (peaks[i + _PREFETCH_AHEAD, 0] + 0.5))
            y = math.floor(coarser * (peaks[i + _PREFETCH_AHEAD, 1] + 0.5))
            for row in range(y - reach, y + reach + 1):  # a row fits into one or two cache lines
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
        clearness, trial = _clearest(pixels, at, samples, rough, dark, bright, max_spread, values)
        if clearness > 0.0:
            rings[count, 0] = factor * coarser * (peaks[i, 0] + 0.5) - 0.5
            rings[count, 1] = factor * coarser * (peaks[i, 1] + 0.5) - 0.5
            rings[count, 2], rings[count, 3] = radius * _TRIALS[trial], clearness
            count += 1
    return count


@compiled
def _steps(offsets: IndexArray, width: int) -> _Addresses:
    """Return the address steps from a peak to its samples, in an image of this width.

    Negative steps are unsigned numbers that wrap around when they are added to an address.
    """
    steps: _Addresses = (offsets[1] * width + offsets[0]).view(np.uintp)
    return steps


@compiled
def _keep_inside(
    offsets: IndexArray, x: int, y: int, width: int, height: int, places: _Addresses
) -> None:
    """Fill in the addresses of samples; those beyond the border are moved to border pixels."""
    columns, rows, out = offsets[0].reshape(-1), offsets[1].reshape(-1), places.reshape(-1)
    for k in range(len(out)):
        column = min(max(x + columns[k], 0), width - 1)
        out[k] = min(max(y + rows[k], 0), height - 1) * width + column


@inlined
def _rough_radius(
    pixels: GreyArray, at: np.uintp, steps: _Addresses, dark: int, bright: int
) -> int:
    """Return the index of the rough radius that fits a ring best, or -1 if none does."""
    most, best = _MIN_OF_FEW - 1, -1
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
    max_spread: float,
    values: GreyArray,
) -> tuple[float, int]:
    """Return the largest clearness of the radii around a rough one, and that radius's index."""
    best, clearest = 0, 0.0
    for k in range(rough * len(_FINE), (rough + 1) * len(_FINE)):
        if _count_directions(pixels, at, steps, k, _MANY, dark, bright) >= _MIN_OF_MANY:
            clearness = _clearness(pixels, at, steps, k, max_spread, values)
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

    In even light, one grey value separates them in all directions. In shade, the light differs
    between directions. The surround is the brighter of two circles: if the plate's margin is narrow
    only the near circle shows it, and if blur spreads the ring's edge only the far one.
    """
    count = 0
    for k in range(directions):
        ring = np.int64(pixels[at + steps[trial, _RING, k]])
        near = pixels[at + steps[trial, _NEAR, k]]
        surround = np.int64(max(near, pixels[at + steps[trial, _FAR, k]]))
        in_even_light = (ring < dark) & (surround > bright)
        in_shade = surround > _SHADE_RATIO * ring + _MIN_CONTRAST
        count += int(in_even_light | in_shade)
    return count


@compiled
def _clearness(
    pixels: GreyArray,
    at: np.uintp,
    steps: _Addresses,
    trial: int,
    max_spread: float,
    values: GreyArray,
) -> float:
    """Return the contrast minus half of the ring's spread; 0 if a test fails."""
    for k in range(_ALL):
        values[0, k] = pixels[at + steps[trial, _RING, _MANY + k]]
        values[1, k] = pixels[at + steps[trial, _CORE, _MANY + k]]
    ring_dark, ring, ring_bright = _order_statistics(values[0], _RING_RANKS)
    core_dark, core, core_bright = _order_statistics(values[1], _CORE_RANKS)
    contrast, spread = core - ring, ring_bright - ring_dark
    # most fail by ring and core already, so the surround is sampled only afterwards
    if contrast < _MIN_CONTRAST or spread > max_spread * contrast:
        return 0.0
    if core_bright - core_dark > _MAX_SHADE_UNEVENNESS * contrast:
        return 0.0
    for k in range(_ALL):
        near = pixels[at + steps[trial, _NEAR, _MANY + k]]
        values[2, k] = max(near, pixels[at + steps[trial, _FAR, _MANY + k]])
    plate_dark, plate, plate_bright = _order_statistics(values[2], _PLATE_RANKS)
    contrast = min(core, plate) - ring
    if contrast < _MIN_CONTRAST or spread > max_spread * contrast:
        return 0.0
    unevenness = max(core_bright - core_dark, plate_bright - plate_dark, abs(core - plate))
    if unevenness > _MAX_SHADE_UNEVENNESS * contrast:
        return 0.0
    if unevenness > _MAX_UNEVENNESS * contrast and not _are_lit_alike(values):
        return 0.0
    return float(max(contrast - 0.5 * spread, 1.0))


@compiled
def _are_lit_alike(values: GreyArray) -> bool:
    """Return whether core and surround differ by nearly the same amount in half of the directions.

    Shade, which falls on both alike, leaves such differences. `values` (3, 24) are the samples on
    ring, core and surround.
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
    apart = np.int16(math.ceil(1 + _MAX_DIFFERENCE_SPREAD * depth))  # 1: rounding
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
    """Return the values of three ascending ranks, counted from 0, without sorting.

    The value of rank r is the largest one that has at most r smaller ones. 24 comparisons fit into
    one vector of bytes, so comparing all pairs is faster than sorting.
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
