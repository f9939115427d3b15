"""Values that do not continue a smooth series."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray

_MAX_PER_SIDE = 4  # neighbours in time
_MIN_PER_SIDE = 2  # a parabola interpolates well, but extrapolates badly
_REACH_INTERVALS = 6.0  # farthest neighbour, in medians of the interval
_LIMIT = 5.0  # standard deviations
_UNREST_FACTOR = 2.0  # of its standard deviation: gusts are not normally distributed
# Standard deviation of a normal distribution over the median and the lower quartile of absolute
# deviations.
_SD_OF_MEDIAN = 1.4826
_SD_OF_QUARTILE = 3.138
_MAX_ROUNDS = 1000


def find_jumps(time_s: FloatArray, value: FloatArray, sd: FloatArray) -> BoolArray:
    """Return which of n values do not continue the parabola through their neighbours.

    Each value is compared with the least-squares parabola through up to four neighbours on either
    side, without the value itself. It jumps if it is off by more than five standard deviations.
    These combine the stated standard deviations with twice the flight's unrest. Unrest is the
    scatter about parabolas beyond the stated standard deviations, of all values or of these
    neighbours, whichever is larger. The worst value of a neighbourhood is removed, and the others
    are compared again. Two wrong values in one neighbourhood can hide each other.

    Parameters
    ----------
    time_s : (n,) array
        Ascending [s].
    value, sd : (n,) array
        In the same unit.
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
    """Return |value − parabola| over its standard deviation (n,); 0 if neighbours are too few."""
    count = len(time_s)
    if count < 2 * _MIN_PER_SIDE + 1:
        return np.zeros(count)
    usual_s = float(np.median(np.diff(time_s)))
    steps = np.array([step for step in range(-_MAX_PER_SIDE, _MAX_PER_SIDE + 1) if step])
    places = np.arange(count)[:, None] + steps
    exists = (places >= 0) & (places < count)
    places = np.clip(places, 0, count - 1)
    since = time_s[places] - time_s[:, None]
    near = exists & (np.abs(since) <= _REACH_INTERVALS * usual_s) & (since != 0.0)
    enough = (near[:, :_MAX_PER_SIDE].sum(1) >= _MIN_PER_SIDE) & (
        near[:, _MAX_PER_SIDE:].sum(1) >= _MIN_PER_SIDE
    )
    if not enough.any():
        return np.zeros(count)
    unit = since / max(usual_s, 1e-9)
    powers = np.stack((np.ones_like(unit), unit, unit**2), axis=2) * near[:, :, None]
    solve = np.zeros((count, 3, len(steps)))
    solve[enough] = np.linalg.pinv(powers[enough])
    share = solve[:, 0, :]  # weight of each neighbour in the parabola's value at the point
    neighbours = value[places] * near
    residual = np.where(enough, value - np.sum(share * neighbours, axis=1), 0.0)
    stated = sd**2 + np.sum((share * sd[places]) ** 2, axis=1)
    spread = 1.0 + np.sum(share**2, axis=1)
    misfit = np.abs(neighbours - np.einsum("npk,nkq,nq->np", powers, solve, neighbours))
    # One wrong value spoils eight other residuals, so that a tenth of wrong values would affect
    # even the median. The lower quartile is more robust.
    quartile = np.quantile(np.abs(residual[enough]) / np.sqrt(spread[enough]), 0.25)
    overall = _SD_OF_QUARTILE * quartile
    unrest = np.maximum(overall, _local_unrest(misfit, near)) ** 2 - stated / spread
    variance = stated + (_UNREST_FACTOR**2) * np.maximum(unrest, 0.0) * spread
    return np.asarray(np.abs(residual) / np.sqrt(np.maximum(variance, 1e-18)))


def _local_unrest(misfit: FloatArray, near: BoolArray) -> FloatArray:
    """Return the standard deviation (n,) of neighbours about their own parabola, by the median.

    Where a climb turns into a descent, values do not follow a parabola although none is wrong.
    """
    count = near.sum(axis=1)
    typical = np.median(np.where(near, misfit, 0.0), axis=1)
    full = count == near.shape[1]
    for row in np.flatnonzero(~full & (count > 3)):
        typical[row] = np.median(misfit[row, near[row]])
    return np.asarray(_SD_OF_MEDIAN * typical * np.sqrt(count / np.maximum(count - 3.0, 1.0)))


def _neighbourhood_maximum(ratio: FloatArray) -> FloatArray:
    padded = np.pad(ratio, _MAX_PER_SIDE, constant_values=0.0)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _MAX_PER_SIDE + 1)
    return np.asarray(windows.max(axis=1))
