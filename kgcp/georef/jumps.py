"""Values that do not continue a smooth series."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray

_SIDE = 4  # neighbours in time on either side, at most
_LEAST_ON_A_SIDE = 2  # a parabola interpolates well, and extrapolates badly
_REACH_INTERVALS = 6.0  # neighbours within this many usual intervals
_LIMIT = 5.0
_UNREST_FACTOR = 2.0  # gusts are not normally distributed
_SD_OF_MEDIAN = 1.4826  # standard deviation of a normal distribution over its median deviation
_SD_OF_QUARTER = 3.138  # the same over the lowest quarter of deviations
_MAX_ROUNDS = 1000


def find_jumps(time_s: FloatArray, value: FloatArray, sd: FloatArray) -> BoolArray:
    """Return which of n values do not continue the parabola through their neighbours.

    Each value is compared with the least-squares parabola through up to four neighbours on either
    side, without the value itself. It jumps if it is off by more than five standard deviations.
    These combine the standard deviations of the values with twice the flight's unrest: the excess
    of the scatter about parabolas, of all values or of these neighbours. The worst value of a
    neighbourhood is removed, and the others are compared again. Two wrong values in one
    neighbourhood can hide each other.

    Parameters
    ----------
    time_s : (n,) array
        Ascending [s].
    value, sd : (n,) array
        Of the same unit.
    """
    jumps = np.zeros(len(time_s), dtype=bool)
    if not len(time_s):
        return jumps
    for _ in range(_MAX_ROUNDS):
        good = np.flatnonzero(~jumps)
        ratio = _departures(time_s[good], value[good], sd[good])
        worst = (ratio > _LIMIT) & (ratio >= _neighbourhood_maximum(ratio))
        if not worst.any():
            break
        jumps[good[worst]] = True
    return jumps


def _departures(time_s: FloatArray, value: FloatArray, sd: FloatArray) -> FloatArray:
    """Return |value − parabola| over its deviation (n,); 0 where there are too few neighbours."""
    count = len(time_s)
    if count < 2 * _LEAST_ON_A_SIDE + 1:
        return np.zeros(count)
    usual_s = float(np.median(np.diff(time_s)))
    steps = np.array([step for step in range(-_SIDE, _SIDE + 1) if step])
    places = np.arange(count)[:, None] + steps
    exists = (places >= 0) & (places < count)
    places = np.clip(places, 0, count - 1)
    since = time_s[places] - time_s[:, None]
    near = exists & (np.abs(since) <= _REACH_INTERVALS * usual_s) & (since != 0.0)
    enough = (near[:, :_SIDE].sum(1) >= _LEAST_ON_A_SIDE) & (
        near[:, _SIDE:].sum(1) >= _LEAST_ON_A_SIDE
    )
    if not enough.any():
        return np.zeros(count)
    unit = since / max(usual_s, 1e-9)
    powers = np.stack((np.ones_like(unit), unit, unit**2), axis=2) * near[:, :, None]
    solve = np.zeros((count, 3, len(steps)))
    solve[enough] = np.linalg.pinv(powers[enough])
    share = solve[:, 0, :]  # of each neighbour in the parabola's value at the point
    beside = value[places] * near
    residual = np.where(enough, value - np.sum(share * beside, axis=1), 0.0)
    stated = sd**2 + np.sum((share * sd[places]) ** 2, axis=1)
    spread = 1.0 + np.sum(share**2, axis=1)
    misfit = np.abs(beside - np.einsum("npk,nkq,nq->np", powers, solve, beside))
    # one wrong value spoils eight residuals: even the median would feel a tenth of such values
    quarter = np.quantile(np.abs(residual[enough]) / np.sqrt(spread[enough]), 0.25)
    overall = _SD_OF_QUARTER * quarter
    unrest = np.maximum(overall, _local_unrest(misfit, near)) ** 2 - stated / spread
    variance = stated + (_UNREST_FACTOR**2) * np.maximum(unrest, 0.0) * spread
    return np.asarray(np.abs(residual) / np.sqrt(np.maximum(variance, 1e-18)))


def _local_unrest(misfit: FloatArray, near: BoolArray) -> FloatArray:
    """Return the median deviation of neighbours from their own parabola (n,).

    Where a climb turns into a descent, nothing follows a parabola although nothing is wrong.
    """
    count = near.sum(axis=1)
    typical = np.median(np.where(near, misfit, 0.0), axis=1)
    full = count == near.shape[1]
    for row in np.flatnonzero(~full & (count > 3)):
        typical[row] = np.median(misfit[row, near[row]])
    return np.asarray(_SD_OF_MEDIAN * typical * np.sqrt(count / np.maximum(count - 3.0, 1.0)))


def _neighbourhood_maximum(ratio: FloatArray) -> FloatArray:
    padded = np.pad(ratio, _SIDE, constant_values=0.0)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _SIDE + 1)
    return np.asarray(windows.max(axis=1))
