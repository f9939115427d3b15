"""Least squares where errors are shared by neighbours in time, and some values are wild."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from kgcp.geometry.arrays import BoolArray, FloatArray

_CORRELATIONS_S = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_SHARES = (0.1, 0.3, 1.0, 3.0, 10.0)
_CLEARLY = 6.0  # of −2 log likelihood: two more parameters gain as much once in twenty times
_ROBUST_ROUNDS = 30
_OUTLIER_SIGMAS = 5.0
_CAUCHY = 2.385  # tuning constant: 95 % efficient for normal errors
_MAD_OF_NORMAL = 0.6745
_SAME_TIME_S = 1e-3

_FLOOR_M2 = 1e-12  # keeps the factor of a share that is zero along an axis invertible


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What is known beforehand about the errors of n observations, in the order of time.

    Attributes
    ----------
    white : (n,) array
        Variances of what is independent from one to the next.
    lasting : (n,) array
        Variances of what lasts for a while; 0: nothing does.
    time_s : (n,) array
        Ascending [s].
    """

    white: FloatArray
    lasting: FloatArray
    time_s: FloatArray

    def kept(self, which: BoolArray) -> Noise:
        """Return the noise of some of the observations."""
        return Noise(self.white[which], self.lasting[which], self.time_s[which])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result of one least squares fit.

    Attributes
    ----------
    values : (p,) array
    cov : (p, p) array
        Their covariance, scaled by the scatter of the residuals.
    outlier : (n,) array of bool
        What fits nothing and had no part.
    variance_factor : float
        χ² over its degrees of freedom, by the noise as it was stated.
    freedom : int
        Degrees of freedom.
    correlation_s : float
        Over which lasting errors fade, the likeliest of a few times; 0: none are evident [s].
    chi2 : float
        Weighted sum of squares that is left.
    moments : (p + 1, p + 1) array
        Weighted products of the columns, each of unit length, and of the observations: enough for
        any part of the model.
    """

    values: FloatArray
    cov: FloatArray
    outlier: BoolArray
    variance_factor: float
    freedom: int
    correlation_s: float
    chi2: float
    moments: FloatArray

    @property
    def sds(self) -> FloatArray:
        """Standard deviations (p,) of the values."""
        return np.asarray(np.sqrt(np.diag(self.cov)))

    def chi2_of(self, columns: list[int]) -> float:
        """Return the weighted sum of squares that some of the columns alone would leave."""
        normal, right = self.moments[np.ix_(columns, columns)], self.moments[columns, -1]
        return float(self.moments[-1, -1] - right @ np.linalg.solve(normal, right))


def fit(design: FloatArray, observed: FloatArray, noise: Noise, *, is_robust: bool = True) -> Fit:
    """Fit design (n, p) to observed (n,), n > p.

    What fits nothing is found first, if it shall be, by Cauchy's weights and the scatter of the
    rest. Then comes generalised least squares: how long the lasting errors last, and how large
    they are against the others, is what makes the residuals likeliest (restricted likelihood).
    The scale of all of them is that of the residuals.
    """
    outlier = np.zeros(len(observed), dtype=bool)
    if is_robust:
        outlier = find_outliers(design, observed, noise.white + noise.lasting)
    kept = ~outlier
    size = np.linalg.norm(design[kept], axis=0)  # distances and their squares, ones and millionths
    columns = np.column_stack((design / size, observed))[kept]
    best, correlation_s = _likeliest(columns, noise.kept(kept))
    count = design.shape[1]
    values = np.asarray(np.linalg.solve(best[:count, :count], best[:count, count]), dtype=float)
    chi2 = max(0.0, float(best[count, count] - best[:count, count] @ values))
    freedom = len(columns) - count
    cov = np.linalg.inv(best[:count, :count]) * chi2 / freedom
    values, cov = values / size, cov / np.outer(size, size)
    return Fit(values, cov, outlier, chi2 / freedom, freedom, correlation_s, chi2, best)


def find_outliers(design: FloatArray, observed: FloatArray, variance: FloatArray) -> BoolArray:
    """Return which of n observations are more than five deviations off a robust fit, (n,)."""
    root = np.sqrt(variance)
    rows, right = design / root[:, None], observed / root
    scale = (
        np.sqrt(np.mean(np.square(np.column_stack((rows, right))), axis=0)) + np.finfo(float).tiny
    )
    rows = rows / scale[:-1]
    weight = np.ones(len(right))
    residual = right
    for _ in range(_ROBUST_ROUNDS):
        half = np.sqrt(weight)
        values = np.linalg.lstsq(half[:, None] * rows, half * right, rcond=None)[0]
        residual = np.abs(right - rows @ values)
        spread = max(float(np.median(residual)) / _MAD_OF_NORMAL, 1e-9 * float(scale[-1]))
        weight = 1.0 / (1.0 + np.square(residual / (_CAUCHY * spread)))
    return np.asarray(residual > _OUTLIER_SIGMAS * spread)


def _likeliest(columns: FloatArray, noise: Noise) -> tuple[FloatArray, float]:
    """Return the weighted products of columns (m, p + 1), and the correlation time."""
    trials = [(0.0, *_independent(columns, noise.white))]
    if np.all(noise.lasting > 0.0):
        trials.append((0.0, *_independent(columns, noise.white + noise.lasting)))
        trials += [
            (time_s, *_correlated(columns, noise, time_s, share))
            for time_s in _CORRELATIONS_S
            for share in _SHARES
        ]
    misfits = [_misfit(moments, log_det, len(columns)) for _, moments, log_det in trials]
    correlation_s, best, _ = trials[int(np.argmin(misfits))]
    is_plain = min(misfits[:2]) - min(misfits) < _CLEARLY
    return best, 0.0 if is_plain else correlation_s


def _misfit(moments: FloatArray, log_det: float, count: int) -> float:
    """Return −2 log of the restricted likelihood, the scale of all variances being free."""
    normal, right = moments[:-1, :-1], moments[:-1, -1]
    chi2 = float(moments[-1, -1] - right @ np.linalg.solve(normal, right))
    freedom = count - len(normal)
    return (
        freedom * float(np.log(max(chi2, np.finfo(float).tiny)))
        + log_det
        + float(np.linalg.slogdet(normal)[1])
    )


def _independent(columns: FloatArray, variance: FloatArray) -> tuple[FloatArray, float]:
    moments = columns.T @ (columns / variance[:, None])
    return np.asarray(moments), float(np.sum(np.log(variance)))


def _correlated(
    columns: FloatArray, noise: Noise, time_s: float, share: float
) -> tuple[FloatArray, float]:
    """Weigh with errors that fade as exp(−|Δt| / time_s), whose inverse covariance is tridiagonal.

    Σ = W + K. By the lemma of Woodbury Σ⁻¹ = W⁻¹ − W⁻¹ (K⁻¹ + W⁻¹)⁻¹ W⁻¹, a banded system.
    """
    step = np.maximum(np.diff(noise.time_s), _SAME_TIME_S)
    kept = np.exp(-step / time_s)
    lost = -np.expm1(-2.0 * step / time_s)
    variance = share * noise.lasting
    band = np.ones((2, len(columns)))
    band[1, :-1] += np.square(kept) / lost
    band[1, 1:] += np.square(kept) / lost
    band[1] = band[1] / variance + 1.0 / noise.white
    band[0, 1:] = -kept / lost / np.sqrt(variance[1:] * variance[:-1])
    factor = cholesky_banded(band)
    scaled = columns / noise.white[:, None]
    moments = columns.T @ scaled - scaled.T @ cho_solve_banded((factor, False), scaled)
    log_det = (
        np.sum(np.log(noise.white))
        + np.sum(np.log(variance))
        + np.sum(np.log(lost))
        + 2.0 * np.sum(np.log(factor[1]))
    )
    return moments, float(log_det)


def whiten(
    time_s: FloatArray,
    fading_m2: FloatArray,
    white_m2: FloatArray,
    correlations_s: FloatArray,
    columns: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return observations and design as if all errors were independent and of variance one.

    The error of observation i is the sum of a white one and of a first-order Gauss-Markov process,
    x_i = exp(-Δt/τ) L_i L_(i-1)⁻¹ x_(i-1) + w_i with L Lᵀ the process's covariance. The
    innovations of its Kalman filter are independent (Kailath 1968, An innovations approach to
    least-squares estimation); applied to every column, the filter is the whitening matrix of
    the full covariance, without forming it.

    Parameters
    ----------
    time_s : (n,) array
        Ascending [s].
    fading_m2, white_m2 : (n, 3, 3) array
        Covariances of the two shares.
    correlations_s : (t,) array
        Values of τ to be tried [s]; 0: both shares are white.
    columns : (n, 3, k) array
        Observations and columns of the design.

    Returns
    -------
    whitened : (t, n, 3, k) array
    log_det : (t,) array
        Logarithm of the full covariance's determinant: -2 log L = χ² + log_det + constant.
    """
    process = fading_m2 + _FLOOR_M2 * np.eye(3)
    factors = np.linalg.cholesky(process)
    steps = factors[1:] @ np.linalg.inv(factors[:-1])
    keep = _kept(time_s, correlations_s)
    whitened = np.empty((len(correlations_s), *columns.shape))
    halves = np.empty((len(correlations_s), *process.shape))
    state, spread = np.zeros((1, *columns.shape[1:])), process[:1]
    for index in range(len(time_s)):
        if index:
            share = keep[:, index - 1, None, None]
            move = share * steps[index - 1]
            state = move @ state
            spread = move @ spread @ np.swapaxes(move, 1, 2) + (1.0 - share**2) * process[index]
        innovation = columns[index] - state
        halves[:, index] = np.linalg.cholesky(spread + white_m2[index])
        root = np.linalg.inv(halves[:, index])
        whitened[:, index] = root @ innovation
        gain = spread @ np.swapaxes(root, 1, 2)
        state = state + gain @ whitened[:, index]
        spread = spread - gain @ np.swapaxes(gain, 1, 2)
    diagonals = np.diagonal(halves, axis1=2, axis2=3)
    return whitened, 2.0 * np.log(diagonals).sum(axis=(1, 2))


def _kept(time_s: FloatArray, correlations_s: FloatArray) -> FloatArray:
    """Return which share (t, n - 1) of an error is left at the next observation."""
    fades = correlations_s[:, None] > 0.0
    rates = np.divide(1.0, correlations_s[:, None], where=fades, out=np.zeros(fades.shape))
    return np.where(fades, np.exp(-np.diff(time_s) * rates), 0.0)
