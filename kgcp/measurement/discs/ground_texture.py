"""The texture of ground (grass, gravel, worn asphalt) as a random field.

The light of pixels at a distance d has the correlation (1 + d/ℓ) exp(−d/ℓ), Matérn's function for
ν = 3/2 (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, eq. 4.17). Its
standard deviation and ℓ are estimated from the ground itself, by restricted likelihood (Patterson
and Thompson, Biometrika 58, 1971).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray

_LENGTHS_PX = (0.8, 1.2, 1.8, 2.7, 4.0, 6.0, 9.0)
_VARIANCES = np.geomspace(0.01, 4.0, 25)  # tried, relative to the variance of the residuals
_USUAL_LENGTH_PX, _SD_LOG_LENGTH = 1.5, 1.0  # prior of ℓ, from photographs of ground


@dataclass(frozen=True, slots=True)
class GroundTexture:
    """How the light of the ground varies."""

    sd: float  # of the light
    length_px: float  # ℓ

    def cov(self, distances_px: FloatArray, by_ground: FloatArray) -> FloatArray:
        """Return the covariance (n, n) of grey values.

        Parameters
        ----------
        distances_px : (n, n) array
            Between the pixels.
        by_ground : (n,) array
            Derivatives of the grey values with respect to the light of the ground.
        """
        by_texture = self.sd * by_ground
        return _correlation(distances_px, self.length_px) * np.multiply.outer(
            by_texture, by_texture
        )


def _correlation(distances_px: FloatArray, length_px: float) -> FloatArray:
    off = distances_px / length_px
    return np.asarray((1.0 + off) * np.exp(-off))


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """Neighbouring pixels."""

    index: IndexArray  # (n,): numbers of the pixels
    places_px: FloatArray  # (2, n)

    def only(self, chosen: BoolArray) -> Sector:
        """Return the sector without the pixels that are not `chosen` (a mask of all pixels)."""
        kept = chosen[self.index]
        return Sector(self.index[kept], self.places_px[:, kept])

    def distances_px(self) -> FloatArray:
        """Return the distances (n, n) between the pixels."""
        x, y = self.places_px
        return np.asarray(np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y)))


def sectors_about(centre_px: FloatArray, places_px: FloatArray, most_pixels: int) -> list[Sector]:
    """Divide pixels (2, n) by their direction from a centre (2,) into sectors of limited size.

    Sectors are treated as independent: the correlation of texture across their borders is left out.
    """
    x, y = places_px - centre_px[:, None]
    order = np.argsort(np.arctan2(y, x), kind="stable")
    parts = np.array_split(order, math.ceil(len(order) / most_pixels))
    return [Sector(index, places_px[:, index]) for index in parts]


@dataclass(frozen=True, slots=True, eq=False)
class _Modes:
    """Eigenvectors (n, n) and eigenvalues (n,) of the correlation within a sector."""

    index: IndexArray  # (n,): of the pixels
    vectors: FloatArray
    values: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TextureModes:
    """Eigenmodes of the ground's correlation in some sectors, for each of `_LENGTHS_PX`.

    With them, the likelihood of a variance is a sum over modes.
    """

    by_length: tuple[tuple[_Modes, ...], ...]

    @classmethod
    def of(cls, ground: Sequence[Sector]) -> TextureModes:
        """Decompose the correlation of every sector."""
        by_length = []
        for length_px in _LENGTHS_PX:
            modes = []
            for part in ground:
                values, vectors = np.linalg.eigh(_correlation(part.distances_px(), length_px))
                modes.append(_Modes(part.index, vectors, values))
            by_length.append(tuple(modes))
        return cls(tuple(by_length))

    def likeliest(self, columns: FloatArray, residuals: FloatArray, noise: float) -> GroundTexture:
        """Return the texture whose ℓ has the greatest restricted likelihood.

        Its variance is the mean over the likelihood at that ℓ.

        Parameters
        ----------
        columns : (n, k) array
            Derivatives of the grey values of all pixels with respect to other unknowns that the
            ground tells; the first is the light of the ground. Pixels of the ground are taken to
            depend on nothing else.
        residuals : (n,) array
        noise : float
            Standard deviation of the pixels' own noise.
        """
        index = np.concatenate([each.index for each in self.by_length[0]])
        by_ground = math.sqrt(float(np.mean(columns[index, 0] ** 2)))
        variances = float(np.mean(residuals[index] ** 2)) * _VARIANCES
        both = np.column_stack((columns, residuals))
        best, least = GroundTexture(0.0, _USUAL_LENGTH_PX), math.inf
        for length_px, parts in zip(_LENGTHS_PX, self.by_length, strict=True):
            off = math.log(length_px / _USUAL_LENGTH_PX) / _SD_LOG_LENGTH
            total = _misfits(parts, both, variances, noise) + 0.5 * off * off
            if float(total.min()) < least:
                least = float(total.min())
                likely = np.exp(least - total)
                variance = float(likely @ variances / likely.sum())
                best = GroundTexture(math.sqrt(variance) / by_ground, length_px)
        return best


def _misfits(
    parts: Sequence[_Modes], both: FloatArray, variances: FloatArray, noise: float
) -> FloatArray:
    """Return the negative logarithms (v,) of the restricted likelihoods of some variances.

    `both` (n, k + 1) has the k derivatives, and the residuals as its last column.
    """
    log_det, width = np.zeros(len(variances)), both.shape[1]
    products = np.zeros((len(variances), width, width))
    for part in parts:
        spectrum = np.multiply.outer(variances, part.values) + noise**2
        rotated = part.vectors.T @ both[part.index]
        products += np.einsum("ni,vn,nj->vij", rotated, 1.0 / spectrum, rotated)
        log_det += np.log(spectrum).sum(axis=1)
    normal, mixed = products[:, :-1, :-1], products[:, :-1, -1]
    solved = np.linalg.solve(normal, mixed[..., None])[..., 0]
    square = products[:, -1, -1] - np.sum(mixed * solved, axis=1)
    return np.asarray(0.5 * (log_det + np.linalg.slogdet(normal)[1] + square))
