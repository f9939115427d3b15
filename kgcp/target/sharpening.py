"""In-camera sharpening: what an unsharp mask adds, at the modelled pixels alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray

_LAYERS = 16  # room for all rows that are sharpened: a full vector of the processor
_TAPS = 7  # of the mask: 2.5 σ to either side, if σ is 1.2 px

SingleArray = npt.NDArray[np.float32]
NumberArray = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """An unsharp mask over a window of which n pixels are modelled.

    The mask is separable. Its first pass, along rows, makes the m values that the second one, along
    columns, needs; it draws on the modelled pixels and on q others.

    Attributes
    ----------
    others : (q,) array of int
        Pixels in reach that are not modelled, in the flattened window.
    along_rows : (m, 7) array of int
        What the first pass adds up: modelled pixels by number, then the others.
    along_columns : (n, 7) array of int
        What the second pass adds up for each modelled pixel.
    kernel : (7,) array
        Weights of either pass, which add up to 1.
    """

    others: IndexArray
    along_rows: NumberArray
    along_columns: NumberArray
    kernel: FloatArray

    def detail(self, values: FloatArray) -> FloatArray:
        """Return what the mask adds at full strength (n,).

        Parameters
        ----------
        values : (n + q,) array
            Of the modelled pixels, then of the others.
        """
        between, smooth = np.empty(len(self.along_rows)), np.empty(len(self.along_columns))
        _smooth(values, self.along_rows, self.kernel, between)
        _smooth(between, self.along_columns, self.kernel, smooth)
        return values[: len(smooth)] - smooth

    def sharpen(
        self, jacobian: FloatArray, rows: IndexArray, others: FloatArray, strength: float
    ) -> None:
        """Sharpen some rows of a Jacobian (…, n).

        In single precision, which is enough for derivatives and takes half the time.

        Parameters
        ----------
        jacobian : (…, n) array
            Changed in place.
        rows : (k,) array of int
        others : (2, q) array
            Values of the first two of these rows at the other pixels, where the rest is 0.
        strength : float
        """
        count = len(self.along_columns)
        layers = np.zeros((count + others.shape[1], _LAYERS), dtype=np.float32)
        between = np.empty((len(self.along_rows), _LAYERS), dtype=np.float32)
        kernel = self.kernel.astype(np.float32)
        _stack(jacobian, rows, layers)
        layers[count:, :2] = others.T
        _smooth_layers(layers, self.along_rows, kernel, between)
        smooth = np.empty((count, _LAYERS), dtype=np.float32)
        _smooth_layers(between, self.along_columns, kernel, smooth)
        _add_detail(layers, smooth, rows, strength, jacobian)


def unsharp_mask(width: int, height: int, index: IndexArray, sigma_px: float) -> Mask:
    """Return the mask of a Gaussian of this σ [px]; the window's border is repeated beyond it.

    Parameters
    ----------
    width, height : int
        Of the window [px].
    index : (n,) array of int
        The modelled pixels in the flattened window.
    sigma_px : float
    """
    along_columns = np.empty((len(index), _TAPS), dtype=np.int32)
    nothing = np.zeros(0, dtype=np.intp)
    needed = _gather(index, nothing, width, height, along_columns, True)  # noqa: FBT003
    along_rows = np.empty((len(needed), _TAPS), dtype=np.int32)
    sources = _gather(needed, index, width, height, along_rows, False)  # noqa: FBT003
    steps = np.arange(_TAPS) - _TAPS // 2
    kernel = np.exp(-0.5 * (steps / sigma_px) ** 2)
    return Mask(sources[len(index) :], along_rows, along_columns, kernel / kernel.sum())


@compiled
def _gather(
    index: IndexArray,
    first: IndexArray,
    width: int,
    height: int,
    numbers: NumberArray,
    is_column: bool,  # noqa: FBT001 - compiled functions have no keywords
) -> IndexArray:
    """Return the pixels that are needed along columns or rows, given ones first.

    The number among them of each that a pixel (n,) needs goes to `numbers` (n, 7).
    """
    reach = numbers.shape[1] // 2
    number = np.full(width * height, -1, np.int32)
    for i in range(len(index)):
        row, column = index[i] // width, index[i] % width
        for j in range(numbers.shape[1]):
            if is_column:
                pixel = min(max(row + j - reach, 0), height - 1) * width + column
            else:
                pixel = row * width + min(max(column + j - reach, 0), width - 1)
            numbers[i, j] = pixel
            number[pixel] = 0
    for pixel in first:
        number[pixel] = -1
    distinct = np.concatenate((first, np.flatnonzero(number == 0)))
    for k in range(len(distinct)):
        number[distinct[k]] = k
    for i in range(len(index)):
        for j in range(numbers.shape[1]):
            numbers[i, j] = number[numbers[i, j]]
    return distinct


@compiled
def _smooth(source: FloatArray, at: NumberArray, kernel: FloatArray, out: FloatArray) -> None:
    """Add up weighted values: out[i] = Σ kernel[j] · source[at[i, j]]."""
    for i in range(at.shape[0]):
        total = 0.0
        for j in range(at.shape[1]):
            total += kernel[j] * source[at[i, j]]
        out[i] = total


@compiled
def _stack(jacobian: FloatArray, rows: IndexArray, layers: SingleArray) -> None:
    """Put all that belongs to a pixel side by side."""
    for i in range(jacobian.shape[1]):
        for k in range(len(rows)):
            layers[i, k] = jacobian[rows[k], i]


@compiled
def _smooth_layers(
    source: SingleArray, at: NumberArray, kernel: SingleArray, out: SingleArray
) -> None:
    """Do as `_smooth` for every layer; all taps at once make full use of vector units."""
    far, farther, farthest, middle = kernel[2], kernel[1], kernel[0], kernel[3]
    for i in range(at.shape[0]):
        a, b, c, d, e, f, g = at[i, 0], at[i, 1], at[i, 2], at[i, 3], at[i, 4], at[i, 5], at[i, 6]
        for k in range(source.shape[1]):
            out[i, k] = (
                middle * source[d, k]
                + far * (source[c, k] + source[e, k])
                + farther * (source[b, k] + source[f, k])
                + farthest * (source[a, k] + source[g, k])
            )


@compiled
def _add_detail(
    layers: SingleArray,
    smooth: SingleArray,
    rows: IndexArray,
    strength: float,
    jacobian: FloatArray,
) -> None:
    """Add what smoothing takes away."""
    for k in range(len(rows)):
        row = jacobian[rows[k]]
        for i in range(len(row)):
            row[i] += strength * (layers[i, k] - smooth[i, k])
