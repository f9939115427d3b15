"""In-camera sharpening by an unsharp mask, computed at the modelled pixels only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray, SingleArray

_LAYERS = 16  # rows of a Jacobian that are sharpened together: a full vector
_TAPS = 7  # length of the kernel: 2.5 σ on either side for σ = 1.2 px

_NOTHING = np.empty(0)

NumberArray = npt.NDArray[np.int32]
_Passes = tuple[NumberArray, NumberArray, FloatArray]
"""`along_rows`, `along_columns` and `kernel` of a `Mask`."""
_Stage = tuple[FloatArray, FloatArray, float]
"""Contributions of the other pixels to the first two rows when smoothed (n,), and the strength."""


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """An unsharp mask over a window of which n pixels are modelled.

    The Gaussian is separable. The first pass, along rows, computes the m values that the second
    pass, along columns, needs. Both use only modelled pixels. The other pixels are taken as
    constant mixtures of ink and plate; their contribution is precomputed.
    """

    # (m, 7): modelled pixels that are summed in the first pass, by number; n stands for none
    along_rows: NumberArray
    # (n, 7): results of the first pass that are summed for each modelled pixel; m stands for none
    along_columns: NumberArray
    kernel: FloatArray  # (7,): weights of either pass; their sum is 1
    # (n,): weight of ink and of plate in other pixels in the smoothed value of each modelled pixel
    ink: FloatArray
    plate: FloatArray

    def detail(
        self, values: FloatArray, ink: float | FloatArray, plate: float | FloatArray
    ) -> FloatArray:
        """Return what the mask adds at a strength of 1 (n,).

        Parameters
        ----------
        values : (n,) array
            Values of the modelled pixels.
        ink, plate : float or (n,) array
            Values of ink and plate in the other pixels, around each modelled pixel.
        """
        smooth = ink * self.ink + plate * self.plate
        _add_smooth_twice(values, self.along_rows, self.along_columns, self.kernel, smooth)
        return np.asarray(values - smooth)

    def sharpen(
        self,
        jacobian: FloatArray,
        rows: IndexArray,
        others: tuple[float | FloatArray, float | FloatArray],
        strength: float,
    ) -> None:
        """Sharpen some rows of a Jacobian (…, n) in place.

        It is done in single precision, which is enough for derivatives.

        Parameters
        ----------
        rows : (k,) array of int
            At most 16 rows. The first two are the derivatives by the levels of ink and plate.
        others : (2,) tuple
            Derivatives of the pixels that are not modelled: of ink by its level, of plate by its
            level.
        """
        from_others = others[0] * self.ink, others[1] * self.plate
        unsharpened = self.ink, self.plate, 0.0
        _sharpen_twice(
            jacobian, rows, self._passes, unsharpened, _NOTHING, _NOTHING, (*from_others, strength)
        )

    def sharpen_around_curve(
        self,
        jacobian: FloatArray,
        rows: IndexArray,
        rare_rows: IndexArray,
        in_light: tuple[float, FloatArray],
        slope: FloatArray,
        others: tuple[float, float],
        strength: float,
    ) -> None:
        """Sharpen in linear light, convert to grey values by a curve, and sharpen again.

        All rows of a Jacobian (…, n) are converted in place, but only the named ones are sharpened.

        Parameters
        ----------
        rows : (k,) array of int
            As for `sharpen`.
        rare_rows : (m,) array of int
            Further rows, which are sharpened only if they are not all 0; mostly they are.
        in_light : float and (n,) array
            Strength in linear light, and what the mask adds there at a strength of 1: these are the
            values of the last of `rows`. Empty if there is no such row.
        slope : (n,) array
            Derivative of the curve; empty if there is none.
        others, strength
            As for `sharpen`, for the grey values.
        """
        before, detail = in_light
        from_others = others[0] * self.ink, others[1] * self.plate
        first, second = (self.ink, self.plate, before), (*from_others, strength)
        _sharpen_twice(jacobian, rows, self._passes, first, detail, slope, second)
        _carry_others(jacobian, rows, rare_rows, self._passes, before, slope, strength)

    @property
    def _passes(self) -> _Passes:
        return self.along_rows, self.along_columns, self.kernel


def unsharp_mask(
    shape: tuple[int, int], index: IndexArray, share: FloatArray, sigma_px: float
) -> Mask:
    """Return the mask with a Gaussian of this σ [px]; border pixels are repeated beyond the window.

    Parameters
    ----------
    shape : (2,) tuple of int
        Rows and columns of the window.
    index : (n,) array of int
        Indices of the modelled pixels in the flattened window.
    share : (rows · columns,) array
        White share of all pixels: 0 for ink, 1 for plate. Used for those that are not modelled.
    """
    along_rows, along_columns = _gather(index, *shape)
    kernel = _gaussian(sigma_px)
    others, plate = np.ones(len(share)), share.copy()
    others[index] = plate[index] = 0.0
    from_others, from_plate = (
        _filtered(values.reshape(shape), kernel) for values in (others, plate)
    )
    ink = (from_others - from_plate).ravel()[index]
    return Mask(along_rows, along_columns, kernel, ink, from_plate.ravel()[index])


@lru_cache(maxsize=8)
def _gaussian(sigma_px: float) -> FloatArray:
    """Return the weights (7,) of one pass."""
    steps = np.arange(_TAPS) - _TAPS // 2
    kernel = np.exp(-0.5 * (steps / sigma_px) ** 2)
    return np.asarray(kernel / kernel.sum())


def _filtered(image: FloatArray, kernel: FloatArray) -> FloatArray:
    border = cv2.BORDER_REPLICATE
    smooth = cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=border)
    return np.asarray(smooth, dtype=np.float64)


@compiled
def _gather(index: IndexArray, height: int, width: int) -> tuple[NumberArray, NumberArray]:
    """Return `along_rows` and `along_columns` of the mask for the pixels (n,) of a window."""
    reach, count = _TAPS // 2, len(index)
    number = np.full((height, width), count, np.int32)  # of the modelled pixel
    # number of the value between the passes; −2: not needed, −1: not numbered yet
    between = np.full((height, width), -2, np.int32)
    for i in range(count):
        row, column = index[i] // width, index[i] % width
        number[row, column] = i
        for beside in range(max(column - reach, 0), min(column + reach + 1, width)):
            between[row, beside] = -1
    along_columns = np.empty((count, _TAPS), np.int32)
    places, used = np.empty(min(_TAPS * count, height * width), np.intp), 0
    for i in range(count):
        row, column = index[i] // width, index[i] % width
        for j in range(_TAPS):
            beside = min(max(row + j - reach, 0), height - 1)
            if between[beside, column] == -1:
                between[beside, column] = used
                places[used] = beside * width + column
                used += 1
            along_columns[i, j] = between[beside, column]
    along_rows = np.empty((used, _TAPS), np.int32)
    for k in range(used):
        row, column = places[k] // width, places[k] % width
        for j in range(_TAPS):
            along_rows[k, j] = number[row, min(max(column + j - reach, 0), width - 1)]
    for i in range(count):
        for j in range(_TAPS):
            along_columns[i, j] = used if along_columns[i, j] < 0 else along_columns[i, j]
    return along_rows, along_columns


@compiled
def _add_smooth_twice(
    values: FloatArray,
    along_rows: NumberArray,
    along_columns: NumberArray,
    kernel: FloatArray,
    smooth: FloatArray,
) -> None:
    """Add the smoothed values (n,) of modelled pixels, without the contribution of the others."""
    modelled, between = np.empty(len(values) + 1), np.zeros(len(along_rows) + 1)
    modelled[:-1], modelled[-1] = values, 0.0
    _add_smooth(modelled, along_rows, kernel, between)
    _add_smooth(between, along_columns, kernel, smooth)


@compiled
def _add_smooth(source: FloatArray, at: NumberArray, kernel: FloatArray, out: FloatArray) -> None:
    """Add weighted sums: out[i] += Σ kernel[j] · source[at[i, j]]; the kernel is symmetric."""
    farthest, farther, far, middle = kernel[0], kernel[1], kernel[2], kernel[3]
    for i in range(at.shape[0]):
        total = middle * source[at[i, 3]]
        total += far * (source[at[i, 2]] + source[at[i, 4]])
        total += farther * (source[at[i, 1]] + source[at[i, 5]])
        out[i] += total + farthest * (source[at[i, 0]] + source[at[i, 6]])


@compiled
def _sharpen_twice(
    jacobian: FloatArray,
    rows: IndexArray,
    passes: _Passes,
    before: _Stage,
    detail: FloatArray,
    slope: FloatArray,
    after: _Stage,
) -> None:
    """Sharpen rows, replace the last one by `detail`, multiply by `slope`, and sharpen again.

    All rows of a pixel are stored side by side, so that vectors go across rows.
    """
    layers = np.zeros((jacobian.shape[1] + 1, _LAYERS), np.float32)
    _stack(jacobian, rows, layers)
    if before[2] != 0.0:
        _sharpen_layers(layers, passes, before)
    if len(detail) > 0:
        for i in range(len(detail)):
            layers[i, len(rows) - 1] = detail[i]
    if len(slope) > 0:
        _multiply(layers, slope)
    _sharpen_layers(layers, passes, after)
    _unstack(layers, rows, jacobian)


@compiled
def _carry_others(
    jacobian: FloatArray,
    rows: IndexArray,
    rare_rows: IndexArray,
    passes: _Passes,
    in_light: float,
    slope: FloatArray,
    strength: float,
) -> None:
    """Convert all rows but `rows` by the curve, and sharpen the rare ones, one by one."""
    is_other, is_rare = np.ones(len(jacobian), np.bool_), np.zeros(len(jacobian), np.bool_)
    is_other[rows] = False
    for row in rare_rows:
        if row < len(jacobian):
            is_rare[row] = np.any(jacobian[row] != 0.0)
    for row in np.flatnonzero(is_other):
        if is_rare[row]:
            _sharpen_row(jacobian[row], passes, in_light)
        if len(slope) > 0:
            for i in range(len(slope)):
                jacobian[row, i] *= slope[i]
        if is_rare[row]:
            _sharpen_row(jacobian[row], passes, strength)


@compiled
def _sharpen_row(values: FloatArray, passes: _Passes, strength: float) -> None:
    if strength == 0.0:
        return
    along_rows, along_columns, kernel = passes
    smooth = np.zeros(len(values))
    _add_smooth_twice(values, along_rows, along_columns, kernel, smooth)
    for i in range(len(values)):
        values[i] += strength * (values[i] - smooth[i])


@compiled
def _sharpen_layers(layers: SingleArray, passes: _Passes, stage: _Stage) -> None:
    along_rows, along_columns, kernel = passes
    ink, plate, strength = stage
    weights = kernel.astype(np.float32)
    between = np.zeros((len(along_rows) + 1, _LAYERS), np.float32)
    _smooth_layers(layers, along_rows, weights, between)
    smooth = np.empty_like(layers)
    _smooth_layers(between, along_columns, weights, smooth)
    _add_detail(smooth, ink, plate, strength, layers)


@compiled
def _stack(jacobian: FloatArray, rows: IndexArray, layers: SingleArray) -> None:
    """Copy rows to layers: the values of a pixel side by side."""
    for i in range(jacobian.shape[1]):
        for k in range(len(rows)):
            layers[i, k] = jacobian[rows[k], i]


@compiled
def _smooth_layers(
    source: SingleArray, at: NumberArray, kernel: SingleArray, out: SingleArray
) -> None:
    """Fill in the weighted sums of `_add_smooth` for every layer."""
    farthest, farther, far, middle = kernel[0], kernel[1], kernel[2], kernel[3]
    for i in range(at.shape[0]):
        a, b, c, d, e, f, g = at[i, 0], at[i, 1], at[i, 2], at[i, 3], at[i, 4], at[i, 5], at[i, 6]
        for k in range(_LAYERS):
            out[i, k] = (
                middle * source[d, k]
                + far * (source[c, k] + source[e, k])
                + farther * (source[b, k] + source[f, k])
                + farthest * (source[a, k] + source[g, k])
            )


@compiled
def _add_detail(
    smooth: SingleArray,
    ink: FloatArray,
    plate: FloatArray,
    strength: float,
    layers: SingleArray,
) -> None:
    """Sharpen every layer: add the difference from its smoothed values, times the strength.

    `ink` and `plate` (n,) are the contributions of other pixels to the smoothed first two layers.
    """
    own, taken = np.float32(1.0 + strength), np.float32(strength)
    values, smooth_values = layers.reshape(-1), smooth.reshape(-1)
    for i in range(len(ink) * _LAYERS):
        values[i] = own * values[i] - taken * smooth_values[i]
    for i in range(len(ink)):
        layers[i, 0] -= strength * ink[i]
        layers[i, 1] -= strength * plate[i]


@compiled
def _multiply(layers: SingleArray, slope: FloatArray) -> None:
    for i in range(len(slope)):
        factor = np.float32(slope[i])
        for k in range(_LAYERS):
            layers[i, k] *= factor


@compiled
def _unstack(layers: SingleArray, rows: IndexArray, jacobian: FloatArray) -> None:
    """Copy layers back to their rows."""
    for i in range(jacobian.shape[1]):
        for k in range(len(rows)):
            jacobian[rows[k], i] = layers[i, k]
