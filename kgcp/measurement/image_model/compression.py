"""What grey values were before JPEG compressed the photograph.

JPEG rounds the cosine transform of every block of 8 × 8 pixels to multiples of 64 steps. At the
edge of a disc, most of what tells the tone curve from the blur is below half a step and is gone.
Taken for noise, that bends the curve. So a coefficient only says that it was within half a step
of what is left of it (interval censoring): that is what the model is compared with.
The steps are read from the photograph itself: its coefficients are their multiples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.measurement.image_model.noise import OUTLIER_SIGMAS, Misfit

_Pixel = TypeVar("_Pixel", bound=np.generic)

_SIDE, _WHITE = 8, 255.0  # of a block; of 8 bits
_MOST_BLOCKS, _FEWEST_BLOCKS = 4000, 30  # the least even ones, to read the steps from, …
_LEAST_RANGE = 24  # … of so many grey values at least
_NEAR_PX = 256  # about a place, in every direction: 1000 to 4000 blocks
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
_LEAST_WEIGHT = 1e-9


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


def is_compressed_near(grey: GreyArray, centre_px: FloatArray) -> bool:
    """Return whether JPEG compressed a photograph, as far as it shows around a place (2,).

    Of a whole photograph, that takes longer than to measure a disc.
    """
    left, top = np.maximum(centre_px.astype(np.intp) - _NEAR_PX, 0) // _SIDE * _SIDE
    near = grey[top : top + 2 * _NEAR_PX, left : left + 2 * _NEAR_PX]
    return quantisation_steps(near) is not None


def _step_of(size: FloatArray) -> float:
    """Return the step that magnitudes (n,) of coefficients are multiples of; NaN: not shown."""
    size = size[size > _NONE]
    if len(size) < _FEWEST_COEFFICIENTS:
        return math.nan
    largest = min(int(np.quantile(size, 0.1) + _NONE), _LARGEST_STEP)
    steps = np.arange(1, largest + 1)
    shown = np.cos(np.outer(2.0 * math.pi / steps, size)).mean(axis=1)
    best = int(np.argmax(shown))  # of fractions of the step, rounded pixels leave less
    left = math.exp(-2.0 * math.pi**2 / (12.0 * float(steps[best]) ** 2))
    return float(steps[best]) if shown[best] > _PERIODIC * left else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class CompressedPixels:
    """Some pixels of a compressed photograph, and what is left of their blocks' coefficients."""

    # (k,): which of the pixels are in blocks that are whole and not clipped
    in_blocks: IndexArray
    places: IndexArray  # (k,): where in the flat blocks
    alone: IndexArray  # (n - k,): the others, which tell for themselves
    observed: FloatArray  # (b, 8, 8): grey values of the blocks
    low: FloatArray  # (b, 8, 8): between which the coefficients were
    high: FloatArray

    @classmethod
    def of(cls, grey: GreyArray, places_px: FloatArray, steps: FloatArray) -> CompressedPixels:
        """Collect the blocks of pixels.

        Parameters
        ----------
        grey : (height, width) array of uint8
            The photograph.
        places_px : (2, n) array
            Pixels that are modelled.
        steps : (8, 8) array
            As of `quantisation_steps`.
        """
        x, y = places_px.astype(np.intp)
        height, width = (side // _SIDE * _SIDE for side in grey.shape)
        number = y // _SIDE * (width // _SIDE) + x // _SIDE
        within = (x < width) & (y < height)
        which = np.unique(number[within])
        rows, columns = np.divmod(which, max(width // _SIDE, 1))
        down, across = np.mgrid[:_SIDE, :_SIDE]
        every = grey[
            (_SIDE * rows)[:, None, None] + down, (_SIDE * columns)[:, None, None] + across
        ].astype(np.float64)
        exact = (every.min(axis=(1, 2)) > 0.0) & (every.max(axis=(1, 2)) < _WHITE)
        place = np.full(height * width // _SIDE**2, -1)
        place[which[exact]] = np.arange(np.count_nonzero(exact))
        block = np.full(len(x), -1)
        block[within] = place[number[within]]
        in_blocks = np.flatnonzero(block >= 0)
        flat = _SIDE**2 * block + _SIDE * (y % _SIDE) + x % _SIDE
        middle = np.rint(_transformed(every[exact]) / steps) * steps
        return cls(
            in_blocks,
            flat[in_blocks],
            np.flatnonzero(block < 0),
            every[exact],
            middle - 0.5 * steps,
            middle + 0.5 * steps,
        )

    def misfit(self, model: FloatArray, sd: FloatArray) -> Misfit:
        """Compare the coefficients with modelled levels (n,) under noise (n,).

        Score and weight are by coefficient (64 b,), in units of `deviations`. As of grey values
        (`kgcp.measurement.image_model.noise`), the loss of what is farther than 3.5 standard
        deviations grows as the logarithm.
        """
        mean, deviation = self._expected(model, sd)
        return Misfit(*_misfit(*(each.ravel() for each in (mean, deviation, self.low, self.high))))

    def deviations(self, sd: FloatArray) -> FloatArray:
        """Return the standard deviations (64 b,) of coefficients under noise (n,) of the levels.

        What is not modelled, ground beyond the pixels, has as much noise as they have.
        """
        variance = (_WHITE * sd[self.in_blocks]) ** 2
        every = np.full(self.observed.size, np.median(variance) if len(variance) else 0.0)
        every[self.places] = variance
        square = _COSINES * _COSINES
        made = square @ every.reshape(self.observed.shape) @ square.T
        return np.asarray(np.sqrt(np.maximum(made, _LEAST_SD_COUNTS**2))).ravel()

    def coefficients(self, rows: FloatArray) -> FloatArray:
        """Return what changes (p, n) of the levels change coefficients by (p, 64 b)."""
        changes = np.zeros((len(rows), self.observed.size))
        changes[:, self.places] = _WHITE * rows[:, self.in_blocks]
        made = changes.reshape(-1, _SIDE**2) @ _COSINES_OF_BLOCK.T  # quicker than by small matrices
        return np.asarray(made.reshape(len(rows), -1))

    def levels_before(
        self, levels: FloatArray, model: FloatArray, sd: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what is expected of levels before they were compressed.

        Parameters
        ----------
        levels : (n,) array
            As observed, 0…1.
        model, sd : (n,) arrays
            As modelled, and the standard deviation of their noise.

        Returns
        -------
        levels : (n,) array
            As observed where a block is cut by the photograph's border, or clipped.
        variance : (n,) array
            By which they may be off.
        """
        mean, deviation = self._expected(model, sd)
        expected, left = _within(mean, deviation, self.low, self.high)
        square = _COSINES * _COSINES
        before, variance = levels.copy(), np.zeros(len(levels))
        before[self.in_blocks] = _restored(expected).ravel()[self.places] / _WHITE
        variance[self.in_blocks] = (square.T @ left @ square).ravel()[self.places] / _WHITE**2
        return before, variance

    def _expected(self, model: FloatArray, sd: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return means and deviations (b, 8, 8) of coefficients, by the model."""
        values = self.observed.ravel().copy()
        values[self.places] = _WHITE * np.clip(model[self.in_blocks], 0.0, 1.0)
        mean = _transformed(values.reshape(self.observed.shape))
        return mean, self.deviations(sd).reshape(mean.shape)


def _within(
    mean: FloatArray, sd: FloatArray, bottom: FloatArray, top: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of normal variables within intervals."""
    low, high = (bottom - mean) / sd, (top - mean) / sd
    below = low > 0.0  # of two tails, their difference is exact only of the smaller ones
    probability = ndtr(np.where(below, -low, high)) - ndtr(np.where(below, -high, low))
    possible: BoolArray = probability > _IMPOSSIBLE
    density = np.stack((_normal(low), _normal(high))) / np.maximum(probability, _IMPOSSIBLE)
    off = density[0] - density[1]
    expected = np.where(possible, mean + sd * off, mean)
    share = 1.0 + low * density[0] - high * density[1] - off * off
    variance = np.where(possible, np.clip(share, 0.0, 1.0), 0.0) * sd**2
    return np.clip(expected, bottom, top), variance


def _misfit(
    mean: FloatArray, sd: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return the negative log-likelihood of intervals, and its derivatives as `Misfit` has them."""
    middle, half = (0.5 * (low + high) - mean) / sd, 0.5 * (high - low) / sd
    sign, nearest = np.where(middle < 0.0, -1.0, 1.0), np.abs(middle) - half
    beyond = np.maximum(nearest / OUTLIER_SIGMAS, 1.0)  # 1: not an outlier
    near = np.minimum(nearest, OUTLIER_SIGMAS)
    far = near + 2.0 * half
    probability = ndtr(-near) - ndtr(-far)
    at_near, at_far = _normal(near) / probability, _normal(far) / probability
    score = at_near - at_far
    # an interval much wider than the noise, of which the mean is well within, tells nothing
    weight = np.maximum(score * score + far * at_far - near * at_near, _LEAST_WEIGHT)
    weight = np.where(beyond > 1.0, score / (OUTLIER_SIGMAS * beyond**2), weight)
    loss = score * OUTLIER_SIGMAS * np.log(beyond) - np.log(probability)
    return float(loss.sum()), sign * score / beyond, weight


def _normal(x: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-0.5 * x * x)) / math.sqrt(2.0 * math.pi)


def _cosines() -> FloatArray:
    """Return the orthonormal cosine transform (8, 8) of a row."""
    order, place = np.mgrid[:_SIDE, :_SIDE]
    rows = np.cos(math.pi * (2 * place + 1) * order / (2 * _SIDE)) * math.sqrt(2.0 / _SIDE)
    rows[0] = math.sqrt(1.0 / _SIDE)
    return np.asarray(rows)


_COSINES = _cosines()
_COSINES_OF_BLOCK = np.kron(_COSINES, _COSINES)  # (64, 64)


def _transformed(blocks: FloatArray) -> FloatArray:
    """Return the coefficients of blocks (…, 8, 8), of grey values about their middle."""
    return _COSINES @ (blocks - 128.0) @ _COSINES.T


def _restored(coefficients: FloatArray) -> FloatArray:
    return _COSINES.T @ coefficients @ _COSINES + 128.0


def _blocks(grey: NDArray[_Pixel]) -> NDArray[_Pixel]:
    """Return the blocks (rows, columns, 8, 8) of a picture of whole ones."""
    rows, columns = (side // _SIDE for side in grey.shape)
    return grey.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)
