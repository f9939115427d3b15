"""The ring filter: box filters that respond to small rings, the first and cheapest test.

A small ring is a bright core in a dark disc in a bright surround. Core and disc are means over 3 x
3 and 5 x 5 pixels. The surround is the mean of nine 5 x 5 means, that is of 7 x 7 pixels with less
weight towards the corners. The score is

    core − disc + surround − disc

It is large where a disc is darker than both its core and its surround, and 0 on planes and in the
middle of edges. docs/method/search.md, "Ring filter", lists the response by radius. Larger rings
are found in reduced images.

The code is written for speed: the filters pass through an image row by row, in strips. Every loop
is over one row of small integers, which is vectorised, and all intermediate results stay in the
processor's cache.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray

# Tuning of the filter. It has two benchmarks: `benchmarks.search.hard_frames` for the targets found
# (results in docs/method/search.md, "Constants of the search"), and
# `benchmarks.speed.relative_costs` for the time that more peaks take in later stages.
PEAK_RADIUS_PX = 2.8
"""Ring radius that a peak stands for; the check tries 0.76 to 1.21 times this radius."""
_UNIT = 225.0 / 4.0  # score per grey value: 225 pixels; only a quarter of it fits into 16 bits
_MIN_SCORE = np.int16(5.0 * _UNIT)  # 5 grey values; a ring's score is at most half of its contrast
_MIN_SHARE = np.int16(0.2 * _UNIT)  # relative to the range of grey values around; less is texture
# Largest number of peaks in an image: this many per pixel, but 1000 in small images.
_MAX_PEAK_SHARE, _MAX_PEAKS = 1 / 400, 1000

_REACH = 4  # rows and columns around a pixel on which a peak there depends
_STRIP = 1024 - 2 * _REACH  # columns of a strip
_VECTOR = 32  # columns are padded to multiples of this
_ROWS = 8  # rows of grey values that are kept; the filters use seven
_KEPT = 3  # rows of filter results that are kept

_Rows = npt.NDArray[np.generic]


@compiled
def find_peaks(reduced: GreyArray, levels: IndexArray) -> tuple[FloatArray, IndexArray]:
    """Return the peaks of the filter's score, image by image.

    A peak is larger than its eight neighbours, at least 5 grey values, and at least a fifth of the
    range of grey values in 5 x 5 pixels. If there are too many peaks, those with the largest share
    of the range are kept.

    Parameters
    ----------
    reduced : (n,) array of uint8
        Images one after the other.
    levels : (m, 4) array of int
        Start and end in `reduced`, height and width of each image.

    Returns
    -------
    peaks : (n, 4) array
        Column and row in the image, interpolated [px]; the mean of core and disc, a grey value
        between those of core and ring; the score relative to the range of grey values.
    ends : (m,) array of int
        Where the peaks of each image end in `peaks`.
    """
    most, kept = 0, 0
    for i in range(len(levels)):
        # maxima are never adjacent
        at_most = ((levels[i, 2] + 1) // 2) * ((levels[i, 3] + 1) // 2)
        most, kept = max(most, at_most), kept + min(at_most, _limit(levels[i]))
    peaks, ends = np.empty((kept + most, 4)), np.empty(len(levels), np.intp)
    count = 0
    for i in range(len(levels)):
        at, end, share = levels[i], count, _MIN_SHARE
        image = reduced[at[0] : at[1]].reshape((at[2], at[3]))
        for first in range(0, image.shape[1], _STRIP):
            end += _scan(image, first, share, peaks[end:])
            if end - count > _limit(at):
                end = count + _keep_best(peaks[count:end], _limit(at))
                share = np.int16(peaks[count:end, 3].min())  # lower ones would be dropped anyway
        count = end
        ends[i] = count
    return peaks[:count], ends


@compiled
def _limit(level: IndexArray) -> int:
    """Return the largest number of peaks of an image."""
    return max(int(_MAX_PEAK_SHARE * (level[1] - level[0])), _MAX_PEAKS)


@compiled
def _keep_best(peaks: FloatArray, limit: int) -> int:
    """Move the `limit` peaks with the largest shares to the front, and return their number.

    Of peaks with equal shares at the limit, the first ones are kept.
    """
    least = np.partition(peaks[:, 3].copy(), len(peaks) - limit)[len(peaks) - limit]
    count, alike = 0, limit - np.sum(peaks[:, 3] > least)
    for i in range(len(peaks)):
        if peaks[i, 3] > least or (peaks[i, 3] == least and alike > 0):
            alike -= peaks[i, 3] == least
            peaks[count] = peaks[i]
            count += 1
    return count


@compiled
def _scan(image: GreyArray, first: int, share: np.int16, peaks: FloatArray) -> int:
    """Fill in the peaks of a strip with at least some share, and return their number.

    Columns: entry 0 of a row lies to the left of the strip's first column: by 4 columns in `grey`
    and `sums`, by 3 in `core`, by 2 in `disc`, `wide` and `extent`, by 1 in `score`.

    Rows: when row r + 2 of the grey values has been read, sums and discs are computed for row r,
    scores for r − 1 and maxima for r − 2. Rows are stored at their numbers modulo 8 (`grey`) or
    modulo 3.
    """
    count = 0
    columns = min(image.shape[1] - first, _STRIP)
    width = -(-(columns + 2 * _REACH) // _VECTOR) * _VECTOR
    longer = width + 2 * _REACH
    grey, sums = np.zeros((_ROWS, longer), np.uint8), np.zeros((2, longer), np.uint16)
    core, disc = np.zeros((_KEPT, longer), np.uint16), np.zeros((_KEPT, longer), np.uint16)
    wide, extent = np.zeros((1, longer), np.uint16), np.zeros((_KEPT, longer), np.uint8)
    score = np.zeros((_KEPT, longer), np.int16)
    words, places = np.zeros(width // 8, np.uint64), np.empty(width + 8, np.int64)
    is_peak = words.view(np.uint8)
    for row in range(-_REACH, 2):
        _copy_row(image, row, first - _REACH, grey)
    for row in range(-2, image.shape[0] + 2):
        _copy_row(image, row + 2, first - _REACH, grey)
        _sum_columns(grey, row, sums, width)
        _sum_rows(sums, (row + _KEPT) % _KEPT, core, disc, width)
        if row < 0:
            continue
        last = (row - 1 + _KEPT) % _KEPT
        _score(core, disc, last, wide, score, width)
        if row < 2:
            continue
        _extents(grey, row - 2, extent, width)
        _mark(score, row - 2, extent, share, is_peak)
        some = places[: _list_marked(words, is_peak, columns, places)]
        if len(some) > 0:
            count += _describe(some, first, row - 2, score, core, disc, extent, peaks[count:])
    return count


@inlined
def _copy_row(image: GreyArray, row: int, first: int, grey: _Rows) -> None:
    """Copy a row from a column on; border pixels are repeated beyond the image."""
    height, width = image.shape
    line, out = image[min(max(row, 0), height - 1)], grey[row % _ROWS]
    left, right = max(-first, 0), min(len(out), width - first)
    source, copy = line[first + left : first + right], out[left:right]
    for x in range(len(copy)):
        copy[x] = source[x]
    out[:left] = line[0]
    out[right:] = line[width - 1]


@inlined
def _sum_columns(grey: _Rows, row: int, sums: _Rows, width: int) -> None:
    """Fill in column sums over three rows and over five rows."""
    a, b, c = (row - 2) % _ROWS, (row - 1) % _ROWS, row % _ROWS
    d, e = (row + 1) % _ROWS, (row + 2) % _ROWS
    for x in range(width):
        sums[0, x] = grey[b, x] + grey[c, x] + grey[d, x]
    for x in range(width):
        sums[1, x] = sums[0, x] + grey[a, x] + grey[e, x]


@inlined
def _sum_rows(sums: _Rows, slot: int, core: _Rows, disc: _Rows, width: int) -> None:
    """Fill in sums over 3 × 3 pixels (`core`) and over 5 × 5 pixels (`disc`)."""
    for x in range(width):
        core[slot, x] = sums[0, x] + sums[0, x + 1] + sums[0, x + 2]
    for x in range(width):
        three = sums[1, x] + sums[1, x + 1] + sums[1, x + 2]
        disc[slot, x] = three + sums[1, x + 3] + sums[1, x + 4]


@inlined
def _score(core: _Rows, disc: _Rows, slot: int, wide: _Rows, score: _Rows, width: int) -> None:
    """Fill in scores from sums over 9, 25 and 225 pixels, in 16 bits.

    The common denominator is 225. 225 · 255 just fits into 16 bits without sign. A quarter of it
    leaves room for signs and differences.
    """
    for x in range(width):
        wide[0, x] = disc[0, x] + disc[1, x] + disc[2, x]
    for x in range(width):
        surround = np.int16(np.uint16(wide[0, x] + wide[0, x + 1] + wide[0, x + 2]) >> 2)
        inner = np.int16(np.uint16(25 * core[slot, x + 2]) >> 2)
        ring = np.int16(np.uint16(9 * disc[slot, x + 1]) >> 2)
        score[slot, x] = inner - ring + surround - ring


@inlined
def _extents(grey: _Rows, row: int, out: _Rows, width: int) -> None:
    """Fill in the range of grey values in 5 x 5 pixels, in row 0 of `out`; rows 1, 2 are used."""
    a, b, c = (row - 2) % _ROWS, (row - 1) % _ROWS, row % _ROWS
    d, e = (row + 1) % _ROWS, (row + 2) % _ROWS
    high, low = 1, 2
    for x in range(width):
        out[high, x] = max(grey[a, x], grey[b, x], grey[c, x], grey[d, x], grey[e, x])
    for x in range(width):
        out[low, x] = min(grey[a, x], grey[b, x], grey[c, x], grey[d, x], grey[e, x])
    for x in range(width):
        out[0, x] = max(
            out[high, x], out[high, x + 1], out[high, x + 2], out[high, x + 3], out[high, x + 4]
        ) - min(out[low, x], out[low, x + 1], out[low, x + 2], out[low, x + 3], out[low, x + 4])


@inlined
def _mark(score: _Rows, row: int, extent: _Rows, share: np.int16, is_peak: _Rows) -> None:
    """Mark pixels larger than their four direct neighbours; of equal ones the first.

    `_describe` tests the diagonal neighbours, since few pixels are left by then.
    """
    before, at, after = (row + 2) % _KEPT, row % _KEPT, (row + 1) % _KEPT
    for x in range(len(is_peak)):
        value = score[at, x + 1]
        is_peak[x] = (
            (value > score[before, x + 1])
            & (value > score[at, x])
            & (value >= score[at, x + 2])
            & (value >= score[after, x + 1])
            & (value >= _MIN_SCORE)
            & (value >= np.int16(share * extent[0, x + 2]))
        )


@inlined
def _list_marked(words: _Rows, is_peak: _Rows, columns: int, places: IndexArray) -> int:
    """Fill in the columns of marked pixels in a row, and return their number.

    Eight marks are tested at once, as one 64-bit word, because nearly all words are 0. Within other
    words, every column is written, and is overwritten by the next one unless it is marked. This
    avoids branches that the processor may mispredict.
    """
    count = 0
    for word in range(-(-columns // 8)):
        if words[word]:
            for x in range(8 * word, 8 * word + 8):
                places[count] = x
                count += is_peak[x] & (x < columns)
    return count


@compiled
def _describe(
    places: IndexArray,
    first: int,
    row: int,
    score: _Rows,
    core: _Rows,
    disc: _Rows,
    extent: _Rows,
    peaks: FloatArray,
) -> int:
    """Fill in the peaks of a row as `find_peaks` returns them, and return their number.

    Marked pixels that are not larger than their diagonal neighbours are left out.
    """
    before, at, after = (row + 2) % _KEPT, row % _KEPT, (row + 1) % _KEPT
    count = 0
    for x in places:
        up, top, down = score[before, x + 1], score[at, x + 1], score[after, x + 1]
        if max(score[before, x], score[before, x + 2]) >= top:
            continue
        if max(score[after, x], score[after, x + 2]) > top:
            continue
        peaks[count, 0] = first + x + _parabola_offset(score[at, x], top, score[at, x + 2])
        peaks[count, 1] = row + _parabola_offset(up, top, down)
        peaks[count, 2] = (25 * core[at, x + 3] + 9 * disc[at, x + 2]) / 450.0
        peaks[count, 3] = top / max(extent[0, x + 2], 1)
        count += 1
    return count


@compiled
def _parabola_offset(before: int, top: int, after: int) -> float:
    """Return the offset of the maximum of a parabola through three scores: within ±0.5."""
    return 0.5 * (before - after) / min(before - 2 * top + after, -1)
