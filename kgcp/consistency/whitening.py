"""Observations with errors that fade over time, made independent of each other."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray

_FLOOR_M2 = 1e-12  # keeps the factor of a share that is zero along an axis invertible


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
