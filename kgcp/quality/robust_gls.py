"""Generalised least squares where errors are shared by neighbours in time, and some are gross.

Observations may be scalars (distances) or vectors (positions); arrays have the shapes of n
observations of dimension d each, and a scalar's variance may stand as (n,) for (n, 1, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import gammaincinv, stdtr

from kgcp.geometry.arrays import BoolArray, FloatArray

_CORRELATIONS_S = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_SHARES = (0.1, 0.3, 1.0, 3.0, 10.0)
_CLEARLY = 6.0  # of −2 log likelihood: two more parameters gain as much once in twenty times
_ROBUST_ROUNDS = 30
_OUTLIER_CHI2 = 25.0  # five standard deviations of a scalar; of 3 coordinates once in 65 000
_CAUCHY = {1: 2.385**2, 3: 3.0}  # tuning by dimension; of a scalar 95 % efficient
_SAME_TIME_S = 1e-6  # keeps the correlation of simultaneous observations invertible
_ALIKE_SHARE = 0.3  # of the largest component of the weakest eigenvector


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """What is known beforehand about the errors of n observations, in the order of time."""

    white: FloatArray  # (n,): variances of what is independent from one to the next
    lasting: FloatArray  # (n,): variances of what lasts for a while; 0: nothing does
    time_s: FloatArray  # (n,): ascending [s]

    @property
    def total(self) -> FloatArray:
        """Variances of both together."""
        return self.white + self.lasting

    def kept(self, which: BoolArray) -> ErrorModel:
        """Return the model of some of the observations."""
        return ErrorModel(self.white[which], self.lasting[which], self.time_s[which])


@dataclass(frozen=True, slots=True, eq=False)
class RegressionFit:
    """Result of one least squares fit."""

    values: FloatArray  # (p,)
    cov: FloatArray  # (p, p): their covariance, scaled by the scatter of the residuals
    outlier: BoolArray  # (n,): observations that took no part, since they fit nothing
    freedom: int  # degrees of freedom
    # over which lasting errors fade, the likeliest of a few times; 0: none are evident [s]
    correlation_s: float
    chi2: float  # weighted sum of squares of the residuals
    # (p + 1, p + 1): weighted products of the columns, each of unit length, and of the
    # observations: enough for any part of the model
    products: FloatArray

    @property
    def sds(self) -> FloatArray:
        """Standard deviations (p,) of the values."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    def chi2_of(self, columns: list[int]) -> float:
        """Return the weighted sum of squares that some of the columns alone would leave."""
        normal, right = self.products[np.ix_(columns, columns)], self.products[columns, -1]
        return float(self.products[-1, -1] - right @ np.linalg.solve(normal, right))


def fit(
    design: FloatArray, observed: FloatArray, errors: ErrorModel, *, is_robust: bool = True
) -> RegressionFit:
    """Fit design (n, p) to scalars (n,), n > p.

    Outliers are left out first, if `is_robust`. Then comes generalised least squares: how long the
    lasting errors last, and how large they are against the others, is what makes the residuals
    likeliest (restricted likelihood). The scale of all of them is that of the residuals.
    """
    outlier = np.zeros(len(observed), dtype=bool)
    if is_robust:
        outlier = find_outliers(design[:, None, :], observed[:, None], errors.total)
    kept = ~outlier
    size = np.linalg.norm(design[kept], axis=0)  # distances and their squares, ones and millionths
    columns = np.column_stack((design / size, observed))[kept]
    best, correlation_s = _likeliest(columns[:, None, :], errors.kept(kept))
    count = design.shape[1]
    values = np.asarray(np.linalg.solve(best[:count, :count], best[:count, count]), dtype=float)
    chi2 = max(0.0, float(best[count, count] - best[:count, count] @ values))
    freedom = len(columns) - count
    cov = np.linalg.inv(best[:count, :count]) * chi2 / freedom
    values, cov = values / size, cov / np.outer(size, size)
    return RegressionFit(values, cov, outlier, freedom, correlation_s, chi2, best)


def find_outliers(
    design: FloatArray,
    observed: FloatArray,
    cov: FloatArray,
    *,
    limits: FloatArray | None = None,
    least_scale: float = 0.0,
) -> BoolArray:
    """Return which of n observations are far off a robust fit, (n,).

    The fit is by Cauchy's weights, observation by observation. Errors are taken as independent,
    which does no harm to the distinction.

    Parameters
    ----------
    design : (n, d, p) array
    observed : (n, d) array
    cov : (n,) or (n, d, d) array
        Variances, which need to be right but for a common factor.
    limits : (p,) array, optional
        Standard deviations of the unknowns beforehand, where the design does not determine all.
    least_scale : float
        Of the variances' common factor: 1 where they are not too large.
    """
    count, dimension, unknowns = design.shape
    half = _root(cov)
    columns = np.concatenate((design, observed[:, :, None]), axis=2)
    whitened = _solved(half, columns).reshape(count * dimension, unknowns + 1)
    size = np.sqrt(np.mean(np.square(whitened), axis=0)) + np.finfo(float).tiny
    rows, right = whitened[:, :-1] / size[:-1], whitened[:, -1]
    beforehand = np.zeros((0, unknowns)) if limits is None else np.diag(1.0 / (limits * size[:-1]))
    least_scale = max(least_scale, (1e-9 * float(size[-1])) ** 2)
    median = 2.0 * float(gammaincinv(0.5 * dimension, 0.5))  # of χ² of this dimension
    weight = np.ones(count)
    for _ in range(_ROBUST_ROUNDS):
        root = np.repeat(np.sqrt(weight), dimension)
        values = np.linalg.lstsq(
            np.vstack((root[:, None] * rows, beforehand)),
            np.concatenate((root * right, np.zeros(len(beforehand)))),
            rcond=None,
        )[0]
        squares = np.sum(np.square(right - rows @ values).reshape(count, dimension), axis=1)
        scale = max(float(np.median(squares)) / median, least_scale)
        weight = 1.0 / (1.0 + squares / (_CAUCHY[dimension] * scale))
    return np.asarray(squares > _OUTLIER_CHI2 * scale)


def _likeliest(columns: FloatArray, errors: ErrorModel) -> tuple[FloatArray, float]:
    """Return the weighted products of columns (m, 1, p + 1), and the correlation time."""
    nothing = np.zeros_like(errors.white)
    white_only = ErrorModel(errors.white, nothing, errors.time_s)
    trials = [(0.0, *whitened_products(columns, white_only, 0.0))]
    if np.all(errors.lasting > 0.0):
        trials.append((0.0, *whitened_products(columns, errors, 0.0)))
        for time_s in _CORRELATIONS_S:
            for share in _SHARES:
                scaled = ErrorModel(errors.white, share * errors.lasting, errors.time_s)
                trials.append((time_s, *whitened_products(columns, scaled, time_s)))
    misfits = [_misfit(products, log_det, len(columns)) for _, products, log_det in trials]
    correlation_s, best, _ = trials[int(np.argmin(misfits))]
    is_plain = min(misfits[:2]) - min(misfits) < _CLEARLY
    return best, 0.0 if is_plain else correlation_s


def _misfit(products: FloatArray, log_det: float, count: int) -> float:
    """Return −2 log of the restricted likelihood, the scale of all variances being free."""
    normal, right = products[:-1, :-1], products[:-1, -1]
    chi2 = float(products[-1, -1] - right @ np.linalg.solve(normal, right))
    freedom = count - len(normal)
    return (
        freedom * float(np.log(max(chi2, np.finfo(float).tiny)))
        + log_det
        + float(np.linalg.slogdet(normal)[1])
    )


def whitened_products(
    columns: FloatArray, errors: ErrorModel, correlation_s: float
) -> tuple[FloatArray, float]:
    """Return Cᵀ Σ⁻¹ C (k, k) of columns C (n, d, k), and log det Σ.

    The lasting errors are a first-order Gauss-Markov process: those of observations i and j have
    the covariance exp(−|Δt| / τ) Lᵢ Lⱼᵀ, with Lᵢ Lᵢᵀ that of i alone. In all Σ = W + L (R ⊗ I) Lᵀ,
    and by the lemma of Woodbury

        Σ⁻¹ = W⁻¹ − W⁻¹ L (R⁻¹ ⊗ I + Lᵀ W⁻¹ L)⁻¹ Lᵀ W⁻¹

    where R⁻¹ is tridiagonal, so that the bracket is a band of width d.

    Parameters
    ----------
    columns : (n, d, k) array
        Of the design, and observations.
    errors : ErrorModel
    correlation_s : float
        τ [s]; 0: all errors are independent.
    """
    count, dimension, width = columns.shape
    if correlation_s == 0.0:
        total = _blocks(errors.total)
        weighted = _solved(total, columns).reshape(-1, width)
        products = columns.reshape(-1, width).T @ weighted
        return np.asarray(products), float(np.linalg.slogdet(total)[1].sum())
    white = _blocks(errors.white)
    half = _root(errors.lasting)
    step = np.maximum(np.diff(errors.time_s), _SAME_TIME_S)
    kept = np.exp(-step / correlation_s)
    lost = -np.expm1(-2.0 * step / correlation_s)
    blocks = np.swapaxes(half, 1, 2) @ _solved(white, half)
    of_r = np.ones(count)
    of_r[:-1] += np.square(kept) / lost
    of_r[1:] += np.square(kept) / lost
    blocks += of_r[:, None, None] * np.eye(dimension)
    band = np.zeros((dimension + 1, count, dimension))
    for row in range(dimension):
        for column in range(row, dimension):
            band[dimension - (column - row), :, column] = blocks[:, row, column]
    band[0, 1:] = (-kept / lost)[:, None]
    factor = cholesky_banded(band.reshape(dimension + 1, -1))
    weighted = _solved(white, columns)
    inner = (np.swapaxes(half, 1, 2) @ weighted).reshape(-1, width)
    products = columns.reshape(-1, width).T @ weighted.reshape(-1, width)
    products = products - inner.T @ cho_solve_banded((factor, False), inner)
    log_det = (
        np.linalg.slogdet(white)[1].sum()
        + dimension * np.sum(np.log(lost))
        + 2.0 * np.sum(np.log(factor[dimension]))
    )
    return np.asarray(products), float(log_det)


def _blocks(variances: FloatArray) -> FloatArray:
    """Return variances as (n, d, d)."""
    return variances[:, None, None] if variances.ndim == 1 else variances


def _root(variances: FloatArray) -> FloatArray:
    """Return the lower Cholesky factors (n, d, d)."""
    return np.asarray(np.linalg.cholesky(_blocks(variances)), dtype=float)


def _solved(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the inverse of a matrix (n, d, d) times columns (n, d, k)."""
    if matrix.shape[1] == 1:  # quicker, and rounded only once
        return columns / matrix
    return np.asarray(np.linalg.solve(matrix, columns), dtype=float)


def separable(
    normal: FloatArray, candidates: Sequence[int], limits: Sequence[float]
) -> tuple[list[int], list[frozenset[int]]]:
    """Return the unknowns that can be estimated together, and the groups that look alike.

    Candidates are taken in the order in which they are believed. One whose variance those before
    it inflate beyond its limit is given up; the weakest eigenvector of the normal matrix, scaled
    to a unit diagonal, names the group that it cannot be told from.

    Parameters
    ----------
    normal : (p, p) array
    candidates : sequence of int
        Rows of the normal matrix, whose diagonal elements are not 0.
    limits : sequence of p float
        Largest inflation of each variance.
    """
    size = np.sqrt(np.diag(normal))
    active: list[int] = []
    groups = []
    for candidate in candidates:
        trial = [*active, candidate]
        unit = normal[np.ix_(trial, trial)] / np.outer(size[trial], size[trial])
        eigenvalues, vectors = np.linalg.eigh(unit)
        inflation = float(np.sum(vectors[-1] ** 2 / np.maximum(eigenvalues, 1e-15)))
        if inflation <= limits[candidate]:
            active = trial
            continue
        weakest = np.abs(vectors[:, 0])
        alike = np.flatnonzero(weakest > _ALIKE_SHARE * weakest.max())
        groups.append(frozenset(trial[index] for index in alike))
    return active, groups


def two_sided(t: float, freedom: int) -> float:
    """Return the probability of a Student's t beyond ± t by chance."""
    return float(2.0 * stdtr(freedom, -abs(t)))
