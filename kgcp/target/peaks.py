"""Where box filters answer to a ring: a first glance at every pixel, which must be cheap."""

from __future__ import annotations

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray

PEAK_RADIUS_PX = 2.8
"""Radius of the rings that the filters answer to most; a quarter more or less is as good."""
_STRIP_PX = 160_000  # pixels filtered at once: what the processor's cache holds
_HALO = 4  # rows that the filters reach
_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
_MIN_ANSWER = 8  # grey values; a ring answers with half of its contrast, or less
_MAX_PEAK_SHARE, _MAX_PEAKS = 1 / 200, 1000  # of the pixels; in small images


def find_peaks(image: GreyArray) -> tuple[FloatArray, FloatArray]:
    """Return where the filters answer clearly.

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
    height, width = image.shape
    rows = max(_STRIP_PX // width, 4 * _HALO)
    buffers = np.empty((6, (rows + 2 * _HALO) * width), dtype=np.uint8)
    strips = []
    for first in range(0, height, rows):
        top = max(first - _HALO, 0)
        strip = image[top : min(first + rows + _HALO, height)]
        core, disc, score, answer, extent = _filter(strip, buffers)
        inner = slice((first - top) * width, (first - top + rows) * width)
        found = np.flatnonzero(answer[inner] >= _MIN_ANSWER) + inner.start
        middle = core[found] // 2 + disc[found] // 2
        share = answer[found] / np.maximum(extent[found], 1.0)
        x, y = (_interpolated(score, found, step) for step in (1, width))
        strips.append((found + top * width, x, y, middle, share))
    places, x, y, middles, shares = (np.concatenate(part) for part in zip(*strips, strict=True))
    most = max(int(_MAX_PEAK_SHARE * height * width), _MAX_PEAKS)
    if len(places) > most:
        clear = shares >= np.partition(shares, -most)[-most]
        places, x, y, middles = (part[clear] for part in (places, x, y, middles))
    rows, columns = np.divmod(places, width)
    return np.column_stack((columns + x, rows + y)), middles.astype(np.float64)


def _filter(
    strip: GreyArray, buffers: GreyArray
) -> tuple[GreyArray, GreyArray, GreyArray, GreyArray, GreyArray]:
    """Return means of core and disc, score, answer and range of grey values, flattened.

    The score is core - disc + surround - disc; the answer is the score where that is a maximum and
    at least a fifth of the range, elsewhere 0.
    """
    size = strip.size
    a, b, c, d, e, f = (buffer[:size].reshape(strip.shape) for buffer in buffers)
    cv2.blur(strip, (3, 3), a, borderType=cv2.BORDER_REPLICATE)
    cv2.blur(strip, (5, 5), b, borderType=cv2.BORDER_REPLICATE)
    cv2.blur(b, (3, 3), c, borderType=cv2.BORDER_REPLICATE)
    cv2.subtract(c, b, c)
    cv2.add(cv2.subtract(a, b, d), c, c)
    peaks = cv2.compare(c, cv2.dilate(c, _NEIGHBOURS, d), cv2.CMP_GE, d)
    answer = cv2.bitwise_and(c, peaks, f)
    cv2.dilate(strip, _NEIGHBOURS, d, iterations=2)
    cv2.erode(strip, _NEIGHBOURS, e, iterations=2)
    extent = cv2.subtract(d, e, d)
    cv2.add(answer, answer, e)
    cv2.add(cv2.add(e, e, e), answer, e)
    cv2.bitwise_and(answer, cv2.compare(e, extent, cv2.CMP_GE, e), f)
    return a.ravel(), b.ravel(), c.ravel(), answer.ravel(), extent.ravel()


def _interpolated(score: GreyArray, found: IndexArray, step: int) -> FloatArray:
    """Return how far beside its maxima the parabola through the scores has its own, ±0.5."""
    before, top, after = (
        np.take(score, found + d, mode="clip").astype(np.float64) for d in (-step, 0, step)
    )
    bend = np.minimum(before - 2.0 * top + after, -1.0)
    return np.asarray(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
