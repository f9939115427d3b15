"""Where box filters answer to a ring: a first glance at every pixel, which must be cheap.

The filters go through an image row by row: every loop is over one row of small integers, of which
the processor takes some tens at once, and all that is between two loops stays in its cache.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, GreyArray

PEAK_RADIUS_PX = 2.8
"""Radius of the rings that the filters answer to most; a quarter more or less is as good."""
_REACH = 4  # rows and columns that the filters look around a pixel, neighbours included
_ROW = 3  # rows that the answers of three are kept of
_UNIT = 225.0 / 4.0  # of scores, per grey value: 3 · 3 · 5 · 5 pixels, and 16 bits hold the quarter
_MIN_SCORE = np.int16(5.0 * _UNIT)  # grey values; a ring's is half of its contrast, or less
_MIN_SHARE = np.int16(0.2 * _UNIT)  # of the range of grey values around

_MAX_PEAK_SHARE, _MAX_PEAKS = 1 / 400, 1000  # of the pixels; in small images

_Row = npt.NDArray[np.generic]


def find_peaks(image: GreyArray) -> tuple[FloatArray, FloatArray]:
    """Return where the filters answer clearly.

    The score is core - disc + surround - disc, of the means of 3 x 3, 5 x 5 and, less at its
    corners, 7 x 7 pixels. It must be a maximum, of some grey values, and at least a fifth of the
    range of grey values in 5 x 5 pixels. Of very many, those with the largest share are kept.

    Parameters
    ----------
    image : (height, width) array of uint8

    Returns
    -------
    points : (n, 2) array
        In the image [px], interpolated.
    middles : (n,) array
        Grey values between those of core and ring.
    """
    padded = cv2.copyMakeBorder(
        image, _REACH, _REACH, _REACH, _REACH, borderType=cv2.BORDER_REPLICATE
    )
    most = ((image.shape[0] + 1) // 2) * ((image.shape[1] + 1) // 2)  # maxima have no neighbours
    points, middles, shares = np.empty((most, 2)), np.empty(most), np.empty(most)
    count = _scan(padded, points, middles, shares)
    kept = np.arange(count)
    limit = max(int(_MAX_PEAK_SHARE * image.size), _MAX_PEAKS)
    if count > limit:
        kept = np.flatnonzero(shares[:count] >= np.partition(shares[:count], -limit)[-limit])
    return points[kept], middles[kept]


@compiled
def _scan(padded: GreyArray, points: FloatArray, middles: FloatArray, shares: FloatArray) -> int:
    """Fill in where the peaks are, grey values between core and ring, shares; return how many.

    Row r of the image is number r + 4 of `padded`. Of what is kept of three rows, each at its
    number modulo 3, entry 0 is in column `reach` of `padded`.
    """
    height, columns = padded.shape[0] - 2 * _REACH, padded.shape[1]
    sums = np.empty(columns, np.uint16)
    core = np.zeros((_ROW, columns - 2), np.uint16)  # reach 1
    disc = np.zeros((_ROW, columns - 4), np.uint16)  # reach 2
    wide = np.empty(columns - 4, np.uint16)
    score = np.zeros((_ROW, columns - 6), np.int16)  # reach 3
    highest = np.zeros((_ROW, columns - 8), np.int16)  # reach 4
    extent = np.empty(columns - 4, np.uint8)
    lowest = np.empty(columns, np.uint8)
    words = np.zeros((columns - 5) // 4, np.uint64)
    answer = words.view(np.int16)[: columns - 8]
    count = 0
    for row in range(2, height + 6):
        _add_three(padded[row - 1], padded[row], padded[row + 1], sums)
        _three_columns(sums, core[row % _ROW])
        _add_five(padded[row - 2 : row + 3], sums)
        _five_columns(sums, disc[row % _ROW])
        if row < _REACH:
            continue
        last = (row - 1) % _ROW
        _add_three(disc[0], disc[1], disc[2], wide)
        _score(core[last, 2:], disc[last, 1:], wide, score[last])
        _highest_of_three(score[last], highest[last])
        if row < _REACH + 2:
            continue
        middle = row - 2
        before, at, after = (middle - 1) % _ROW, middle % _ROW, (middle + 1) % _ROW
        _extents(padded[middle - 2 : middle + 3], sums.view(np.uint8), lowest, extent)
        _mark(score[at], highest[before], highest[at], highest[after], extent[2:], answer)
        for word in range(len(words)):
            if words[word] == 0:
                continue
            for x in range(4 * word, min(4 * word + 4, len(answer))):
                if answer[x] > 0:
                    up, level, down = score[before, x + 1], score[at], score[after, x + 1]
                    points[count, 0] = x + _beside(level[x], level[x + 1], level[x + 2])
                    points[count, 1] = middle - _REACH + _beside(up, level[x + 1], down)
                    middles[count] = core[at, x + 3] / 18.0 + disc[at, x + 2] / 50.0
                    shares[count] = answer[x] / max(float(extent[x + 2]), 1.0)
                    count += 1
    return count


@compiled
def _add_three(one: _Row, two: _Row, three: _Row, out: _Row) -> None:
    for x in range(len(out)):
        out[x] = one[x] + two[x] + three[x]


@compiled
def _add_five(rows: GreyArray, out: _Row) -> None:
    a, b, c, d, e = rows[0], rows[1], rows[2], rows[3], rows[4]
    for x in range(len(out)):
        out[x] = a[x] + b[x] + c[x] + d[x] + e[x]


@compiled
def _three_columns(row: _Row, out: _Row) -> None:
    a, b, c = row, row[1:], row[2:]
    for x in range(len(out)):
        out[x] = a[x] + b[x] + c[x]


@compiled
def _five_columns(row: _Row, out: _Row) -> None:
    a, b, c, d, e = row, row[1:], row[2:], row[3:], row[4:]
    for x in range(len(out)):
        out[x] = a[x] + b[x] + c[x] + d[x] + e[x]


@compiled
def _score(core: _Row, disc: _Row, wide: _Row, out: _Row) -> None:
    """Combine sums over 9, 25 and 225 pixels, so that nothing exceeds 16 bits."""
    a, b, c = wide, wide[1:], wide[2:]
    for x in range(len(out)):
        surround = np.int16(np.uint16(a[x] + b[x] + c[x]) >> 2)
        inner = np.int16(np.uint16(25 * core[x]) >> 2)
        ring = np.int16(np.uint16(9 * disc[x]) >> 2)
        out[x] = inner - ring + surround - ring


@compiled
def _highest_of_three(row: _Row, out: _Row) -> None:
    a, b, c = row, row[1:], row[2:]
    for x in range(len(out)):
        out[x] = max(a[x], b[x], c[x])


@compiled
def _extents(rows: GreyArray, high: GreyArray, low: GreyArray, out: GreyArray) -> None:
    """Return the range of grey values in 5 x 5 pixels; `high` and `low` are for its use."""
    a, b, c, d, e = rows[0], rows[1], rows[2], rows[3], rows[4]
    for x in range(len(low)):
        high[x] = max(a[x], b[x], c[x], d[x], e[x])
    for x in range(len(low)):
        low[x] = min(a[x], b[x], c[x], d[x], e[x])
    a, b, c, d, e = high, high[1:], high[2:], high[3:], high[4:]
    for x in range(len(out)):
        out[x] = max(a[x], b[x], c[x], d[x], e[x])
    a, b, c, d, e = low, low[1:], low[2:], low[3:], low[4:]
    for x in range(len(out)):
        out[x] -= min(a[x], b[x], c[x], d[x], e[x])


@compiled
def _mark(score: _Row, before: _Row, at: _Row, after: _Row, extent: _Row, out: _Row) -> None:
    """Return the scores of peaks, 0 elsewhere. Of equal neighbours the first is a peak."""
    left, here = score, score[1:]
    for x in range(len(out)):
        value = here[x]
        is_peak = (value > before[x]) & (value > left[x]) & (value >= at[x]) & (value >= after[x])
        out[x] = value if is_peak else 0
    for x in range(len(out)):
        value = out[x]
        is_clear = (value >= _MIN_SCORE) & (value >= np.int16(_MIN_SHARE * extent[x]))
        out[x] = value if is_clear else 0


@compiled
def _beside(before: int, top: int, after: int) -> float:
    """Return how far beside a maximum the parabola through the scores has its own, ±0.5."""
    bend = min(before - 2.0 * top + after, -1.0)
    return min(max(0.5 * (before - after) / bend, -0.5), 0.5)
