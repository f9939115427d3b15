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
) -> FloatArray:
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
    """
    if correlation_s == 0.0:
        return np.asarray(np.linalg.solve(np.linalg.cholesky(fading_m2 + white_m2), columns))
    process = fading_m2 + _FLOOR_M2 * np.eye(3)
    factors = np.linalg.cholesky(process)
    keep = np.exp(-np.diff(time_s) / correlation_s)
    moves = keep[:, None, None] * factors[1:] @ np.linalg.inv(factors[:-1])
    whitened = np.empty_like(columns)
    state, spread = np.zeros(columns.shape[1:]), process[0]
    for index in range(len(time_s)):
        if index:
            move, kept = moves[index - 1], keep[index - 1] ** 2
            state = move @ state
            spread = move @ spread @ move.T + (1.0 - kept) * process[index]
        innovation = columns[index] - state
        total = spread + white_m2[index]
        whitened[index] = np.linalg.solve(np.linalg.cholesky(total), innovation)
        gain = np.linalg.solve(total, spread).T
        state = state + gain @ innovation
        spread = spread - gain @ spread
        spread = 0.5 * (spread + spread.T)
    return whitened
