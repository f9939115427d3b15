"""Observations with errors that fade over time, made independent of each other."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray

_FLOOR_M2 = 1e-12  # keeps the factor of a share that is zero along an axis invertible


def whiten(
    time_s: FloatArray,
    fading_m2: FloatArray,
    white_m2: FloatArray,
    correlation_s: float,
    columns: FloatArray,
) -> tuple[FloatArray, float]:
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
    correlation_s : float
        τ [s]; 0: both shares are white.
    columns : (n, 3, k) array
        Observations and columns of the design.

    Returns
    -------
    whitened : (n, 3, k) array
    log_det : float
        Logarithm of the full covariance's determinant: -2 log L = χ² + log_det + constant.
    """
    if correlation_s == 0.0:
        half = np.asarray(np.linalg.cholesky(fading_m2 + white_m2), dtype=np.float64)
        return np.asarray(np.linalg.solve(half, columns)), _log_det(half)
    process = fading_m2 + _FLOOR_M2 * np.eye(3)
    factors = np.linalg.cholesky(process)
    keep = np.exp(-np.diff(time_s) / correlation_s)
    moves = keep[:, None, None] * factors[1:] @ np.linalg.inv(factors[:-1])
    whitened, halves = np.empty_like(columns), np.empty_like(process)
    state, spread = np.zeros(columns.shape[1:]), process[0]
    for index in range(len(time_s)):
        if index:
            move, kept = moves[index - 1], keep[index - 1] ** 2
            state = move @ state
            spread = move @ spread @ move.T + (1.0 - kept) * process[index]
        innovation = columns[index] - state
        halves[index] = np.linalg.cholesky(spread + white_m2[index])
        root = np.linalg.inv(halves[index])
        whitened[index] = root @ innovation
        gain = spread @ root.T
        state = state + gain @ whitened[index]
        spread = spread - gain @ gain.T
    return whitened, _log_det(halves)


def _log_det(halves: FloatArray) -> float:
    return 2.0 * float(np.log(np.diagonal(halves, axis1=1, axis2=2)).sum())
