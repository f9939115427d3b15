"""What grey values were before JPEG compressed the photograph.

JPEG rounds the cosine transform of every block of 8 × 8 pixels to multiples of 64 steps. At the
edge of a disc, most of what tells the tone curve from the blur is below half a step and is gone.
Taken for noise, that bends the curve. So a coefficient only says that it was within half a step
of what is left of it (interval censoring), and values are estimated from that and from the model.
The steps are read from the photograph itself: its coefficients are their multiples.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray

_Pixel = TypeVar("_Pixel", bound=np.generic)

_SIDE, _WHITE = 8, 255.0  # of a block; of 8 bits
_MOST_BLOCKS, _FEWEST_BLOCKS = 4000, 30  # the least even ones, to read the steps from, …
_LEAST_RANGE = 24  # … of so many grey values at least
_NONE = 1.4  # coefficients up to here may be zero: rounded pixels leave a deviation of 0.29
_FEWEST_COEFFICIENTS = 20
_LARGEST_STEP = 255
# Least mean of cos(2π c / step) over coefficients c, of what rounded pixels leave of it
_PERIODIC = 0.6
_LEAST_DETERMINED = 6  # steps of 64, …
# … and the share of those that enough coefficients could show. JPEG leaves 0.6 or more of them.
# Where blocks begin elsewhere, since the photograph was cropped or resized, or where nothing was
# compressed, it is 0.45 at most: coefficients that fade out above `_NONE` look like multiples.
_LEAST_SHARE = 0.55
_LEAST_SD_COUNTS = 0.3  # quantisation of grey values alone
_IMPOSSIBLE = 1e-8  # probability of an interval, below which only its nearer end counts


def quantisation_steps(grey: GreyArray) -> FloatArray | None:
    """Return the steps (8, 8) that JPEG rounded the blocks' coefficients to; None if it did not.

    They are in grey values of the orthonormal transform, rows by vertical frequency. None, too, if
    the photograph was cropped or resized since, or if its steps are 1 for the most part. Steps that
    no coefficient shows are as large as the largest of those of lower frequencies.
    """
    height, width = (side // _SIDE * _SIDE for side in grey.shape)
    if grey.dtype != np.uint8 or not height or not width:
        return None
    blocks = _blocks(grey[:height, :width]).reshape(-1, _SIDE, _SIDE)
    low, high = blocks.min(axis=(1, 2)), blocks.max(axis=(1, 2))
    ranges = high.astype(np.intp) - low
    # clipped ones are not exact; of flat ones, roundings are alike and add up
    useful = np.flatnonzero((low > 0) & (high < _WHITE) & (ranges >= _LEAST_RANGE))
    if len(useful) < _FEWEST_BLOCKS:
        return None
    uneven = useful[np.argsort(-ranges[useful], kind="stable")[:_MOST_BLOCKS]]
    size = np.abs(_transformed(blocks[uneven].astype(np.float64))).reshape(len(uneven), -1)
    steps = np.array([_step_of(each) for each in size.T])
    seen = np.isfinite(steps)
    if np.count_nonzero(seen) < _LEAST_DETERMINED or np.median(steps[seen]) < 2.0:
        return None
    could_be = np.count_nonzero(size > _NONE, axis=0) >= _FEWEST_COEFFICIENTS
    if np.count_nonzero(seen) < _LEAST_SHARE * np.count_nonzero(could_be):
        return None
    known = np.where(seen, steps, 1.0).reshape(_SIDE, _SIDE)
    lower = np.maximum.accumulate(np.maximum.accumulate(known, axis=0), axis=1)
    return np.where(seen.reshape(_SIDE, _SIDE), known, lower)


def _step_of(size: FloatArray) -> float:
    """Return the step that magnitudes (n,) of coefficients are multiples of; NaN: not shown."""
    size = size[size > _NONE]
    if len(size) < _FEWEST_COEFFICIENTS:
        return math.nan
    largest = min(int(np.quantile(size, 0.1) + _NONE), _LARGEST_STEP)
    steps = np.arange(1, largest + 1)
    shown = np.array([np.mean(np.cos((2.0 * math.pi / step) * size)) for step in steps.tolist()])
    best = int(np.argmax(shown))  # of fractions of the step, rounded pixels leave less
    left = math.exp(-2.0 * math.pi**2 / (12.0 * float(steps[best]) ** 2))
    return float(steps[best]) if shown[best] > _PERIODIC * left else math.nan


def levels_before(
    grey: GreyArray, places_px: FloatArray, model: FloatArray, sd: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what is expected of levels before they were compressed.

    Parameters
    ----------
    grey : (height, width) array of uint8
        The photograph.
    places_px : (2, n) array
        Pixels that are modelled.
    model, sd : (n,) arrays
        Their levels, 0…1, and the standard deviation of their noise.
    steps : (8, 8) array
        As of `quantisation_steps`.

    Returns
    -------
    levels : (n,) array
        As observed where a block is cut by the photograph's border, or clipped.
    variance : (n,) array
        By which they may be off.
    """
    x, y = places_px.astype(np.intp)
    height, width = (side // _SIDE * _SIDE for side in grey.shape)
    levels, variance = grey[y, x] / _WHITE, np.zeros(len(x))
    within = (x < width) & (y < height)
    if not within.any():
        return levels, variance
    x, y = x[within], y[within]
    x0, y0 = x.min() // _SIDE * _SIDE, y.min() // _SIDE * _SIDE
    x1, y1 = (x.max() // _SIDE + 1) * _SIDE, (y.max() // _SIDE + 1) * _SIDE
    observed = grey[y0:y1, x0:x1].astype(np.float64)
    modelled, noise = observed.copy(), np.zeros_like(observed)
    modelled[y - y0, x - x0] = np.clip(model[within], 0.0, 1.0) * _WHITE
    noise[y - y0, x - x0] = (sd[within] * _WHITE) ** 2
    blocks = _blocks(observed)
    exact = (blocks.min(axis=(2, 3)) > 0.0) & (blocks.max(axis=(2, 3)) < _WHITE)
    of_block = np.sqrt(np.maximum(_blocks(noise).mean(axis=(2, 3)), _LEAST_SD_COUNTS**2))
    middle = np.rint(_transformed(blocks) / steps) * steps
    expected, left = _within(_transformed(_blocks(modelled)), of_block, middle, 0.5 * steps)
    before = np.where(exact[..., None, None], _restored(expected), blocks)
    lost = np.where(exact, left.mean(axis=(2, 3)), 0.0)
    levels[within] = _whole(before)[y - y0, x - x0] / _WHITE
    variance[within] = lost[(y - y0) // _SIDE, (x - x0) // _SIDE] / _WHITE**2
    return levels, variance


def _within(
    mean: FloatArray, sd: FloatArray, middle: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of normal variables within intervals (rows, columns, 8, 8)."""
    sd = sd[..., None, None]
    low, high = (middle - half - mean) / sd, (middle + half - mean) / sd
    below = low > 0.0  # of two tails, their difference is exact only of the smaller ones
    probability = ndtr(np.where(below, -low, high)) - ndtr(np.where(below, -high, low))
    possible: BoolArray = probability > _IMPOSSIBLE
    density = np.stack((_normal(low), _normal(high))) / np.maximum(probability, _IMPOSSIBLE)
    off = density[0] - density[1]
    expected = np.where(possible, mean + sd * off, mean)
    share = 1.0 + low * density[0] - high * density[1] - off * off
    variance = np.where(possible, np.clip(share, 0.0, 1.0), 0.0) * sd**2
    return np.clip(expected, middle - half, middle + half), variance


def _normal(x: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * x * x)) / math.sqrt(2.0 * math.pi)


def _cosines() -> FloatArray:
    """Return the orthonormal cosine transform (8, 8) of a row."""
    order, place = np.mgrid[:_SIDE, :_SIDE]
    rows = np.cos(math.pi * (2 * place + 1) * order / (2 * _SIDE)) * math.sqrt(2.0 / _SIDE)
    rows[0] = math.sqrt(1.0 / _SIDE)
    return np.asarray(rows)


_COSINES = _cosines()


def _transformed(blocks: FloatArray) -> FloatArray:
    """Return the coefficients of blocks (…, 8, 8), of grey values about their middle."""
    return _COSINES @ (blocks - 128.0) @ _COSINES.T


def _restored(coefficients: FloatArray) -> FloatArray:
    return _COSINES.T @ coefficients @ _COSINES + 128.0


def _blocks(grey: NDArray[_Pixel]) -> NDArray[_Pixel]:
    """Return the blocks (rows, columns, 8, 8) of a picture of whole ones."""
    rows, columns = (side // _SIDE for side in grey.shape)
    return grey.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)


def _whole(blocks: FloatArray) -> FloatArray:
    """Return the picture of blocks (rows, columns, 8, 8)."""
    rows, columns = blocks.shape[:2]
    return blocks.swapaxes(1, 2).reshape(_SIDE * rows, _SIDE * columns)
