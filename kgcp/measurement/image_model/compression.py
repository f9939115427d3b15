"""Comparison of a model with grey values that JPEG has compressed.

JPEG divides a photograph into blocks of 8 × 8 pixels and rounds the 64 coefficients of each block's
cosine transform to multiples of a quantisation step, one step per frequency. At the edge of a disc,
most of the signal that separates the tone curve from the blur is smaller than half a step, and is
lost. If this loss were treated as noise, the estimated curve would be bent.

Therefore a coefficient only says that its value before rounding was within half a step of its
present one (interval censoring), and the model is compared with these intervals. The steps are
estimated from the photograph itself, since its coefficients are multiples of them.
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

_SIDE, _WHITE = 8, 255.0  # side of a block [px]; largest 8-bit grey value
# Steps are estimated from the blocks with the largest range of grey values: at least 30 and at most
# 4000 blocks, each with a range of 24 or more.
_MAX_BLOCKS, _MIN_BLOCKS = 4000, 30
_MIN_RANGE = 24
_NEAR_PX = 256  # half width of the surroundings that are tested: 1000 to 4000 blocks
# Smaller coefficients may have been rounded to zero. The rounding of pixels to grey values leaves a
# standard deviation of 0.29 in them.
_MAX_ZERO = 1.4
_MIN_COEFFICIENTS = 20
_MAX_STEP = 255
# A step is accepted if the mean of cos(2π c / step) over coefficients c is at least this share of
# the value that is left after the rounding of pixels.
_MIN_PERIODICITY = 0.6
# Compression is detected if this many of the 64 steps are determined, and if this is at least the
# given share of the steps for which there are enough coefficients. With JPEG the share is 0.6 or
# more. It is at most 0.45 if nothing was compressed, or if the photograph was cropped or resized so
# that the blocks begin elsewhere. (It is not 0 then, because coefficients that become rare above
# `_MAX_ZERO` look like multiples.)
_MIN_DETERMINED = 6
_MIN_DETERMINED_SHARE = 0.55
# The table that the JPEG standard proposes for grey values (ITU-T T.81, 1992, table K.1). Libjpeg,
# and with it most programs, scales it by the quality. A scaled table is recognised if it agrees
# with at least this share of the determined steps.
_PROPOSED_STEPS = np.array(
    (
        (16, 11, 10, 16, 24, 40, 51, 61),
        (12, 12, 14, 19, 26, 58, 60, 55),
        (14, 13, 16, 24, 40, 57, 69, 56),
        (14, 17, 22, 29, 51, 87, 80, 62),
        (18, 22, 37, 56, 68, 109, 103, 77),
        (24, 35, 55, 64, 81, 104, 113, 92),
        (49, 64, 78, 87, 103, 121, 120, 101),
        (72, 92, 95, 98, 112, 100, 103, 99),
    )
)
_MIN_AGREEING_SHARE = 0.9
# Largest difference between a block and what its coefficients decode to, if they are right. The
# rounding of pixels makes 0.5, a decoder's integers a little more.
_MAX_DECODING_ERROR_COUNTS = 1.1
_MIN_SD_COUNTS = 0.3  # noise in grey values, due to quantisation alone
_MIN_PROBABILITY = 1e-8  # of an interval; if it is smaller, only the nearer end counts
_MIN_WEIGHT = 1e-9


def quantisation_steps(grey: GreyArray) -> FloatArray | None:
    """Return JPEG's quantisation steps (8, 8) of a photograph; None if there are none.

    They are in grey values of the orthonormal transform; the row is the vertical frequency. None is
    returned if the photograph was not compressed, if it was cropped or resized afterwards, or if
    most steps are 1. If the determined steps are those of a usual table, the others are taken from
    it. Otherwise, they are set to the largest step of lower frequencies.
    """
    height, width = (side // _SIDE * _SIDE for side in grey.shape)
    if grey.dtype != np.uint8 or not height or not width:
        return None
    blocks = _blocks(grey[:height, :width]).reshape(-1, _SIDE, _SIDE)
    low, high = blocks.min(axis=(1, 2)), blocks.max(axis=(1, 2))
    ranges = high.astype(np.intp) - low
    # clipped blocks are not exact; in flat ones, rounding errors are alike and add up
    useful = np.flatnonzero((low > 0) & (high < _WHITE) & (ranges >= _MIN_RANGE))
    if len(useful) < _MIN_BLOCKS:
        return None
    uneven = useful[np.argsort(-ranges[useful], kind="stable")[:_MAX_BLOCKS]]
    size = np.abs(_transformed(blocks[uneven].astype(np.float64))).reshape(len(uneven), -1)
    steps = np.array([_step_of(each) for each in size.T])
    is_determined = np.isfinite(steps)
    if np.count_nonzero(is_determined) < _MIN_DETERMINED or np.median(steps[is_determined]) < 2.0:
        return None
    is_determinable = np.count_nonzero(size > _MAX_ZERO, axis=0) >= _MIN_COEFFICIENTS
    if np.count_nonzero(is_determined) < _MIN_DETERMINED_SHARE * np.count_nonzero(is_determinable):
        return None
    usual = _usual_steps(steps)
    if usual is not None:
        return usual
    known = np.where(is_determined, steps, 1.0).reshape(_SIDE, _SIDE)
    lower = np.maximum.accumulate(np.maximum.accumulate(known, axis=0), axis=1)
    return np.where(is_determined.reshape(_SIDE, _SIDE), known, lower)


def _usual_steps(steps: FloatArray) -> FloatArray | None:
    """Return the table (8, 8) of the quality that agrees with steps (64,); None: none does.

    Steps that are not determined are NaN.
    """
    qualities = np.arange(1, 101)
    percent = np.where(qualities < 50, 5000 // qualities, 200 - 2 * qualities)
    tables = np.clip((np.outer(percent, _PROPOSED_STEPS) + 50) // 100, 1, 255)
    is_determined = np.isfinite(steps)
    agreeing = np.mean(tables[:, is_determined] == steps[is_determined], axis=1)
    best = int(np.argmax(agreeing))
    if agreeing[best] < _MIN_AGREEING_SHARE:
        return None
    return np.asarray(tables[best].reshape(_SIDE, _SIDE), np.float64)


def is_compressed_near(grey: GreyArray, centre_px: FloatArray) -> bool:
    """Return whether JPEG compressed a photograph, judged by the surroundings of a place (2,).

    To analyse the whole photograph would take longer than to measure a disc.
    """
    left, top = np.maximum(centre_px.astype(np.intp) - _NEAR_PX, 0) // _SIDE * _SIDE
    near = grey[top : top + 2 * _NEAR_PX, left : left + 2 * _NEAR_PX]
    return quantisation_steps(near) is not None


def _step_of(size: FloatArray) -> float:
    """Return the step whose multiples the magnitudes (n,) of coefficients are; NaN if unclear."""
    size = size[size > _MAX_ZERO]
    if len(size) < _MIN_COEFFICIENTS:
        return math.nan
    largest = min(int(np.quantile(size, 0.1) + _MAX_ZERO), _MAX_STEP)
    steps = np.arange(1, largest + 1)
    periodicity = np.cos(np.outer(2.0 * math.pi / steps, size)).mean(axis=1)
    # fractions of the true step have a lower periodicity, because pixels are rounded
    best = int(np.argmax(periodicity))
    expected = math.exp(-2.0 * math.pi**2 / (12.0 * float(steps[best]) ** 2))
    return float(steps[best]) if periodicity[best] > _MIN_PERIODICITY * expected else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class CompressedPixels:
    """Some pixels of a compressed photograph, and the intervals of their blocks' coefficients."""

    # (k,): indices of the pixels in blocks that are complete and whose coefficients are known
    in_blocks: IndexArray
    places: IndexArray  # (k,): their indices in the flattened blocks
    # (n - k,): indices of the other pixels, which are compared one by one
    outside_blocks: IndexArray
    observed: FloatArray  # (b, 8, 8): grey values of the blocks, before they were clipped
    # (b, 8, 8): limits of the coefficients before rounding
    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, grey: GreyArray, places_px: FloatArray, steps: FloatArray) -> CompressedPixels:
        """Collect the blocks that contain pixels.

        Parameters
        ----------
        grey : (height, width) array of uint8
            The photograph.
        places_px : (2, n) array
            x, y of the pixels that are modelled.
        steps : (8, 8) array
            Result of `quantisation_steps`.
        """
        x, y = places_px.astype(np.intp)
        height, width = (side // _SIDE * _SIDE for side in grey.shape)
        number = y // _SIDE * (width // _SIDE) + x // _SIDE
        within = (x < width) & (y < height)
        which, place = np.unique(number[within], return_inverse=True)
        rows, columns = np.divmod(which, max(width // _SIDE, 1))
        down, across = np.mgrid[:_SIDE, :_SIDE]
        block_values = grey[
            (_SIDE * rows)[:, None, None] + down, (_SIDE * columns)[:, None, None] + across
        ].astype(np.float64)
        middle = np.rint(_transformed(block_values) / steps) * steps
        decoded = _restored(middle)
        low, high = block_values.min(axis=(1, 2)), block_values.max(axis=(1, 2))
        # Where the decoder has clipped some pixels, coefficients are often the nearest multiples
        # nevertheless. If they are, they decode to the same block.
        is_clipped = (low <= 0.0) | (high >= _WHITE)
        error = np.abs(np.clip(decoded, 0.0, _WHITE) - block_values).max(axis=(1, 2))
        exact = ~is_clipped | (error < _MAX_DECODING_ERROR_COUNTS)
        before_clipping = np.where(is_clipped[:, None, None], decoded, block_values)[exact]
        middle = middle[exact]
        block = np.full(len(x), -1)
        block[within] = np.where(exact, np.cumsum(exact) - 1, -1)[place]
        in_blocks = np.flatnonzero(block >= 0)
        flat = _SIDE**2 * block + _SIDE * (y % _SIDE) + x % _SIDE
        return cls(
            in_blocks,
            flat[in_blocks],
            np.flatnonzero(block < 0),
            before_clipping,
            middle - 0.5 * steps,
            middle + 0.5 * steps,
        )

    def misfit(self, model: FloatArray, deviations: FloatArray) -> Misfit:
        """Compare the coefficients with modelled levels (n,).

        Score and weight are those of the coefficients (64 b,), in units of their standard
        deviations. As for grey values (`kgcp.measurement.image_model.noise`), the loss grows as the
        logarithm beyond 3.5 standard deviations.

        Parameters
        ----------
        deviations : (64 b,) array
            Result of `deviations`.
        """
        mean = self._expected(model).ravel()
        return Misfit(*_misfit(mean, deviations, self.low.ravel(), self.high.ravel()))

    def deviations(self, sd: FloatArray) -> FloatArray:
        """Return the standard deviations (64 b,) of coefficients under noise `sd` (n,).

        Pixels of the blocks that are not modelled, such as ground, are given the median noise of
        those that are.
        """
        variance = (_WHITE * sd[self.in_blocks]) ** 2
        variances = np.full(self.observed.size, np.median(variance) if len(variance) else 0.0)
        variances[self.places] = variance
        square = _COSINES * _COSINES
        made = square @ variances.reshape(self.observed.shape) @ square.T
        return np.asarray(np.sqrt(np.maximum(made, _MIN_SD_COUNTS**2))).ravel()

    def coefficients(self, rows: FloatArray) -> FloatArray:
        """Return the changes (p, 64 b) of coefficients by changes of levels (p, n)."""
        changes = np.zeros((len(rows), self.observed.size))
        changes[:, self.places] = _WHITE * rows[:, self.in_blocks]
        made = changes.reshape(-1, _SIDE**2) @ _COSINES_OF_BLOCK.T  # faster than 8 × 8 products
        return np.asarray(made.reshape(len(rows), -1))

    def levels_before(
        self, levels: FloatArray, model: FloatArray, sd: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the expected levels before compression.

        Parameters
        ----------
        levels : (n,) array
            Observed levels, 0…1.
        model, sd : (n,) arrays
            Modelled levels, and the standard deviations of their noise.

        Returns
        -------
        levels : (n,) array
            The expected levels; the observed ones where a block is clipped or cut by the
            photograph's border.
        variance : (n,) array
            Their variances; 0 for observed ones.
        """
        mean = self._expected(model)
        deviation = self.deviations(sd).reshape(mean.shape)
        expected, left = _within(mean, deviation, self.low, self.high)
        square = _COSINES * _COSINES
        before, variance = levels.copy(), np.zeros(len(levels))
        before[self.in_blocks] = _restored(expected).ravel()[self.places] / _WHITE
        variance[self.in_blocks] = (square.T @ left @ square).ravel()[self.places] / _WHITE**2
        return before, variance

    def _expected(self, model: FloatArray) -> FloatArray:
        """Return the modelled coefficients (b, 8, 8)."""
        values = self.observed.ravel().copy()
        values[self.places] = _WHITE * np.clip(model[self.in_blocks], 0.0, 1.0)
        return _transformed(values.reshape(self.observed.shape))


def _within(
    mean: FloatArray, sd: FloatArray, bottom: FloatArray, top: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of normal variables that are known to lie within intervals."""
    low, high = (bottom - mean) / sd, (top - mean) / sd
    below = low > 0.0  # whether lower tails are subtracted: small tails keep their digits
    probability = ndtr(np.where(below, -low, high)) - ndtr(np.where(below, -high, low))
    possible: BoolArray = probability > _MIN_PROBABILITY
    density = np.stack((_normal(low), _normal(high))) / np.maximum(probability, _MIN_PROBABILITY)
    mean_shift = density[0] - density[1]
    expected = np.where(possible, mean + sd * mean_shift, mean)
    share = 1.0 + low * density[0] - high * density[1] - mean_shift * mean_shift
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
    # an interval much wider than the noise with the mean well inside tells nothing
    weight = np.maximum(score * score + far * at_far - near * at_near, _MIN_WEIGHT)
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
    """Return the coefficients of blocks (…, 8, 8) of grey values, relative to 128."""
    return _COSINES @ (blocks - 128.0) @ _COSINES.T


def _restored(coefficients: FloatArray) -> FloatArray:
    return _COSINES.T @ coefficients @ _COSINES + 128.0


def _blocks(grey: NDArray[_Pixel]) -> NDArray[_Pixel]:
    """Return the blocks (rows, columns, 8, 8) of an image that consists of complete blocks."""
    rows, columns = (side // _SIDE for side in grey.shape)
    return grey.reshape(rows, _SIDE, columns, _SIDE).swapaxes(1, 2)
