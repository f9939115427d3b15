"""In-camera sharpening: what an unsharp mask adds, at the modelled pixels alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.compiled import compiled
from kgcp.geometry.arrays import FloatArray, IndexArray

_REACH_SIGMAS = 2.5  # of the mask


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """An unsharp mask over a window of which n pixels are modelled.

    The mask is separable. Its first pass, along rows, makes the m values that the second one, along
    columns, needs; it draws on the modelled pixels and on q others.

    Attributes
    ----------
    others : (q,) array of int
        Pixels in reach that are not modelled, in the flattened window.
    along_rows : (m, 2 r + 1) array of int
        What the first pass adds up: modelled pixels by number, then the others.
    along_columns : (n, 2 r + 1) array of int
        What the second pass adds up for each modelled pixel.
    kernel : (2 r + 1,) array
        Weights of either pass, which add up to 1.
    """

    others: IndexArray
    along_rows: IndexArray
    along_columns: IndexArray
    kernel: FloatArray

    def detail(self, layers: FloatArray) -> FloatArray:
        """Return what the mask adds at full strength (n, k).

        Parameters
        ----------
        layers : (n + q, k) array
            Values of the modelled pixels, then of the others, layer by layer.
        """
        between = np.empty((len(self.along_rows), layers.shape[1]))
        _add_up(layers, self.along_rows, self.kernel, between)
        smooth = np.empty((len(self.along_columns), layers.shape[1]))
        _add_up(between, self.along_columns, self.kernel, smooth)
        detail: FloatArray = layers[: len(smooth)] - smooth
        return detail


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
    reach = math.ceil(_REACH_SIGMAS * sigma_px)
    steps = np.arange(-reach, reach + 1)
    row, column = np.divmod(index, width)
    above = np.clip(row[:, None] + steps, 0, height - 1) * width + column[:, None]
    needed, along_columns = _numbered(above, width * height, np.zeros(0, dtype=np.intp))
    row, column = np.divmod(needed, width)
    beside = row[:, None] * width + np.clip(column[:, None] + steps, 0, width - 1)
    sources, along_rows = _numbered(beside, width * height, index)
    kernel = np.exp(-0.5 * (steps / sigma_px) ** 2)
    return Mask(sources[len(index) :], along_rows, along_columns, kernel / kernel.sum())


def _numbered(pixels: IndexArray, size: int, first: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return the distinct pixels, given ones first, and the number of every pixel among them."""
    occurs = np.zeros(size, dtype=bool)
    occurs[pixels] = True
    occurs[first] = False
    distinct = np.concatenate((first, np.flatnonzero(occurs)))
    number = np.empty(size, dtype=np.intp)
    number[distinct] = np.arange(len(distinct))
    return distinct, number[pixels]


@compiled
def _add_up(source: FloatArray, at: IndexArray, kernel: FloatArray, out: FloatArray) -> None:
    """Add up weighted rows of a table: out[i] = Σ kernel[j] · source[at[i, j]]."""
    for i in range(at.shape[0]):
        for k in range(source.shape[1]):
            out[i, k] = 0.0
        for j in range(at.shape[1]):
            row, weight = at[i, j], kernel[j]
            for k in range(source.shape[1]):
                out[i, k] += weight * source[row, k]
