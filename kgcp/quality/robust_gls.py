"""Generalised least squares for errors that are correlated in time, with rejection of outliers.

There are n observations of dimension d: scalars (distances) or vectors (positions). Variances of
scalars may have the shape (n,) instead of (n, 1, 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import gammaincinv, stdtr

from kgcp.geometry.arrays import BoolArray, FloatArray

_CORRELATION_TIMES_S = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_SCALES = (0.1, 0.3, 1.0, 3.0, 10.0)  # factors that are tried on the stated correlated variances
# Least gain in −2 log likelihood with which a correlation is believed. By chance, its two
# additional parameters gain as much in one of twenty cases.
_MIN_GAIN = 6.0
_ROBUST_ROUNDS = 30
# χ² of one observation: five standard deviations of a scalar; for 3 coordinates, a probability of
# 1 in 65 000.
_OUTLIER_CHI2 = 25.0
_CAUCHY = {1: 2.385**2, 3: 3.0}  # squared tuning constant by dimension; 95 % efficient for scalars
_MIN_STEP_S = 1e-6  # keeps the correlation of simultaneous observations invertible
_GROUP_SHARE = 0.3  # least component of a group's unknowns in an eigenvector, of its largest one


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Stated errors of n observations, in the order of time."""

    independent: FloatArray  # (n,) or (n, d, d): variances of independent errors
    correlated: FloatArray  # the same of errors that are correlated in time; 0: there are none
    time_s: FloatArray  # (n,): ascending [s]

    @property
    def total(self) -> FloatArray:
        """Variances of both together."""
        return self.independent + self.correlated

    def kept(self, which: BoolArray) -> ErrorModel:
        """Return the model of some of the observations."""
        return ErrorModel(self.independent[which], self.correlated[which], self.time_s[which])


@dataclass(frozen=True, slots=True, eq=False)
class RegressionFit:
    """Result of one least squares fit."""

    values: FloatArray  # (p,)
    cov: FloatArray  # (p, p): their covariance, scaled by the scatter of the residuals
    outlier: BoolArray  # (n,): observations that were left out
    freedom: int  # degrees of freedom
    # correlation time, the likeliest of `_CORRELATION_TIMES_S`; 0: no correlation is evident [s]
    correlation_s: float
    chi2: float  # weighted sum of squares of the residuals
    # (p + 1, p + 1): weighted products of the p columns, normalised to unit length, and of the
    # observations; from these, any part of the model can be fitted
    products: FloatArray

    @property
    def sds(self) -> FloatArray:
        """Standard deviations (p,) of the values."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    def chi2_of(self, columns: list[int]) -> float:
        """Return the weighted sum of squares after a fit of some of the columns only."""
        normal, right = self.products[np.ix_(columns, columns)], self.products[columns, -1]
        return float(self.products[-1, -1] - right @ np.linalg.solve(normal, right))


def fit(
    design: FloatArray, observed: FloatArray, errors: ErrorModel, *, is_robust: bool = True
) -> RegressionFit:
    """Fit design (n, p) to scalars (n,), n > p.

    If `is_robust`, outliers are removed first. Then follows a fit by generalised least squares. The
    correlation time, and the scale of the correlated errors relative to the independent ones, are
    the likeliest ones (restricted likelihood). The residuals determine the scale of all errors.
    """
    outlier = np.zeros(len(observed), dtype=bool)
    if is_robust:
        outlier = find_outliers(design[:, None, :], observed[:, None], errors.total)
    kept = ~outlier
    size = np.linalg.norm(design[kept], axis=0)  # columns differ by orders of magnitude
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
    min_scale: float = 0.0,
) -> BoolArray:
    """Return which of n observations are far from a robust fit, (n,).

    The fit uses Cauchy's weights, one for each observation. Errors are taken as independent, which
    is good enough to recognise outliers.

    Parameters
    ----------
    design : (n, d, p) array
    observed : (n, d) array
    cov : (n,) or (n, d, d) array
        Variances; a common factor does not matter.
    limits : (p,) array, optional
        A-priori standard deviations of the unknowns, if the design may not determine them all.
    min_scale : float
        Least common factor of the variances: 1 if they are known not to be too large.
    """
    count, dimension, unknowns = design.shape
    half = _root(cov)
    columns = np.concatenate((design, observed[:, :, None]), axis=2)
    whitened = _solved(half, columns).reshape(count * dimension, unknowns + 1)
    size = np.sqrt(np.mean(np.square(whitened), axis=0)) + np.finfo(float).tiny
    rows, right = whitened[:, :-1] / size[:-1], whitened[:, -1]
    prior_rows = np.zeros((0, unknowns)) if limits is None else np.diag(1.0 / (limits * size[:-1]))
    min_scale = max(min_scale, (1e-9 * float(size[-1])) ** 2)
    median = 2.0 * float(gammaincinv(0.5 * dimension, 0.5))  # of χ² of this dimension
    weight = np.ones(count)
    for _ in range(_ROBUST_ROUNDS):
        root = np.repeat(np.sqrt(weight), dimension)
        values = np.linalg.lstsq(
            np.vstack((root[:, None] * rows, prior_rows)),
            np.concatenate((root * right, np.zeros(len(prior_rows)))),
            rcond=None,
        )[0]
        squares = np.sum(np.square(right - rows @ values).reshape(count, dimension), axis=1)
        scale = max(float(np.median(squares)) / median, min_scale)
        weight = 1.0 / (1.0 + squares / (_CAUCHY[dimension] * scale))
    return np.asarray(squares > _OUTLIER_CHI2 * scale)


def _likeliest(columns: FloatArray, errors: ErrorModel) -> tuple[FloatArray, float]:
    """Return the weighted products of columns (m, 1, p + 1) by the likeliest correlation, its time.

    The time is 0 unless a correlation is clearly likelier than independent errors.
    """
    nothing = np.zeros_like(errors.independent)
    independent_only = ErrorModel(errors.independent, nothing, errors.time_s)
    trials = [(0.0, *whitened_products(columns, independent_only, 0.0))]
    if np.all(errors.correlated > 0.0):
        trials.append((0.0, *whitened_products(columns, errors, 0.0)))
        for time_s in _CORRELATION_TIMES_S:
            for scale in _SCALES:
                scaled = ErrorModel(errors.independent, scale * errors.correlated, errors.time_s)
                trials.append((time_s, *whitened_products(columns, scaled, time_s)))
    misfits = [_misfit(products, log_det, len(columns)) for _, products, log_det in trials]
    correlation_s, best, _ = trials[int(np.argmin(misfits))]
    is_uncorrelated = min(misfits[:2]) - min(misfits) < _MIN_GAIN
    return best, 0.0 if is_uncorrelated else correlation_s


def _misfit(products: FloatArray, log_det: float, count: int) -> float:
    """Return −2 log of the restricted likelihood, with the likeliest scale of all variances."""
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

    The correlated errors are a first-order Gauss-Markov process: those of observations i and j have
    the covariance exp(−|Δt| / τ) Lᵢ Lⱼᵀ, where Lᵢ Lᵢᵀ is the covariance of i alone. With the
    independent errors W and the correlations R, Σ = W + L (R ⊗ I) Lᵀ, and by Woodbury's lemma

        Σ⁻¹ = W⁻¹ − W⁻¹ L (R⁻¹ ⊗ I + Lᵀ W⁻¹ L)⁻¹ Lᵀ W⁻¹

    R⁻¹ is tridiagonal, so that the bracket is a band matrix of bandwidth d.

    Parameters
    ----------
    columns : (n, d, k) array
        Columns of the design, and the observations.
    errors : ErrorModel
    correlation_s : float
        τ [s]; 0: all errors are independent.
    """
    count, dimension, width = columns.shape
    if correlation_s == 0.0:
        total = _as_matrices(errors.total)
        weighted = _solved(total, columns).reshape(-1, width)
        products = columns.reshape(-1, width).T @ weighted
        return np.asarray(products), float(np.linalg.slogdet(total)[1].sum())
    independent = _as_matrices(errors.independent)
    half = _root(errors.correlated)
    step = np.maximum(np.diff(errors.time_s), _MIN_STEP_S)
    kept = np.exp(-step / correlation_s)
    lost = -np.expm1(-2.0 * step / correlation_s)
    blocks = np.swapaxes(half, 1, 2) @ _solved(independent, half)
    diagonal = np.ones(count)  # of R⁻¹
    diagonal[:-1] += np.square(kept) / lost
    diagonal[1:] += np.square(kept) / lost
    blocks += diagonal[:, None, None] * np.eye(dimension)
    band = np.zeros((dimension + 1, count, dimension))
    for row in range(dimension):
        for column in range(row, dimension):
            band[dimension - (column - row), :, column] = blocks[:, row, column]
    band[0, 1:] = (-kept / lost)[:, None]
    factor = cholesky_banded(band.reshape(dimension + 1, -1))
    weighted = _solved(independent, columns)
    inner = (np.swapaxes(half, 1, 2) @ weighted).reshape(-1, width)
    products = columns.reshape(-1, width).T @ weighted.reshape(-1, width)
    products = products - inner.T @ cho_solve_banded((factor, False), inner)
    log_det = (
        np.linalg.slogdet(independent)[1].sum()
        + dimension * np.sum(np.log(lost))
        + 2.0 * np.sum(np.log(factor[dimension]))
    )
    return np.asarray(products), float(log_det)


def with_shared_errors(
    products: FloatArray, log_det: float, count: int
) -> tuple[FloatArray, float]:
    """Return products and log det as `whitened_products` with errors that all observations share.

    With their effects S by one standard deviation, the covariance is Σ + S Sᵀ.

    Parameters
    ----------
    products : (k, k) array
        The last `count` of the k columns are S; they are left out of the result.
    """
    others = len(products) - count
    inner = np.eye(count) + products[others:, others:]
    by_shared = products[:others, others:]
    reduced = products[:others, :others] - by_shared @ np.linalg.solve(inner, by_shared.T)
    return np.asarray(reduced), log_det + float(np.linalg.slogdet(inner)[1])


def _as_matrices(variances: FloatArray) -> FloatArray:
    """Return variances as (n, d, d)."""
    return variances[:, None, None] if variances.ndim == 1 else variances


def _root(variances: FloatArray) -> FloatArray:
    """Return the lower Cholesky factors (n, d, d)."""
    return np.asarray(np.linalg.cholesky(_as_matrices(variances)), dtype=float)


def _solved(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the inverse of a matrix (n, d, d) times columns (n, d, k)."""
    if matrix.shape[1] == 1:  # quicker, and rounded only once
        return columns / matrix
    return np.asarray(np.linalg.solve(matrix, columns), dtype=float)


def separable_unknowns(
    normal: FloatArray, candidates: Sequence[int], limits: Sequence[float]
) -> tuple[list[int], list[frozenset[int]]]:
    """Return the unknowns that can be estimated together, and groups that cannot be separated.

    Candidates are taken in their order, the likeliest first. A candidate is given up if the
    unknowns before it inflate its variance beyond the limit. Its group are the unknowns with large
    components in the weakest eigenvector of the normal matrix, scaled to a unit diagonal.

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
        members = np.flatnonzero(weakest > _GROUP_SHARE * weakest.max())
        groups.append(frozenset(trial[index] for index in members))
    return active, groups


def two_sided_probability(t: float, freedom: int) -> float:
    """Return the probability that Student's t lies beyond ± t by chance."""
    return float(2.0 * stdtr(freedom, -abs(t)))
