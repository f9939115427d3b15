"""Test whether the focal length changes with the distance of the field, or during the session.

If a lens is focused on the field, as by autofocus, its image distance is longer than at infinity by
its focal length over the distance of the field, as a share. Zoom and focus can also change between
two photographs, or two sessions be given as one. Poses take up most of such changes: in photographs
from 0.5 to 0.8 m by a lens of 8 mm with 2300 px, residuals of 0.014 px become 0.02 to 0.04 px. But
the focal length is then that of the mean distance, and 1.3 % too long at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.covariance import REDUNDANCY_POWER, without_pose
from kgcp.network.equations import ViewRows, network_rows, view_rows
from kgcp.network.records import Estimate, Network, Precision, Solution

# With six or seven places, the scatter is known too badly: of 44 simulated sessions without a
# trend, two thirds of them of bending boards or with a rolling shutter, the only one with p < 0.001
# had six.
_MIN_PLACES = 8
_MIN_PLACES_APART = 3  # before and after a step


@dataclass(frozen=True, slots=True)
class FocalTrend:
    """Change of the focal length with the distance, estimated beside all other unknowns."""

    # Relative change by the reciprocal of the distance. It is the lens's own focal length, if it is
    # focused on the field and none of its elements moves against the others.
    lens_m: float
    change_px: float  # of the focal length, from the farthest to the nearest photograph
    p_value: float  # probability of such a change by chance, from its scatter between places


@dataclass(frozen=True, slots=True)
class FocalStep:
    """Change of the focal length between two photographs: the most significant one."""

    first: int  # number of the first photograph after the change
    change_px: float
    # probability of such a change by chance, wherever it were, from the scatter between places
    p_value: float


@dataclass(frozen=True, slots=True)
class FocalChanges:
    """Changes of the focal length; None: the photographs cannot tell."""

    trend: FocalTrend | None
    step: FocalStep | None


def focal_changes(network: Network, solution: Solution, precision: Precision) -> FocalChanges:
    """Return how the focal length of one camera changes, if photographs are from eight places.

    Each change is one further unknown of the linearised adjustment. All others are eliminated. Its
    standard deviation follows from the scatter between places, but is at least the formal one.
    """
    places = precision.places
    if int(places.max()) + 1 < _MIN_PLACES:
        return FocalChanges(None, None)
    closeness = 1.0 / _distances_m(solution.estimate)
    numbers = np.arange(len(places))
    first = np.array(
        [
            k
            for k in numbers.tolist()
            if min(len(set(places[:k])), len(set(places[k:]))) >= _MIN_PLACES_APART
        ],
        dtype=np.intp,
    )
    by_photograph = np.vstack([closeness - closeness.mean(), numbers >= first[:, None]])
    shares, p_values = _shares(network, solution, precision, by_photograph)
    focal_px = float(solution.estimate.cameras[0, 0])
    trend = FocalTrend(
        float(shares[0]), float(shares[0] * np.ptp(closeness)) * focal_px, float(p_values[0])
    )
    return FocalChanges(
        trend if np.isfinite(shares[0]) else None,
        _clearest_step(first, focal_px * shares[1:], p_values[1:]),
    )


def _clearest_step(
    first: IndexArray, changes_px: FloatArray, p_values: FloatArray
) -> FocalStep | None:
    if not np.isfinite(p_values).any():
        return None
    best = int(np.nanargmin(p_values))
    by_chance = min(1.0, len(first) * float(p_values[best]))
    return FocalStep(int(first[best]), float(changes_px[best]), by_chance)


def _distances_m(estimate: Estimate) -> FloatArray:
    """Return the distances (v,) between the cameras and the middle of the field [m]."""
    middles = estimate.rotations @ estimate.points.mean(axis=0) + estimate.translations
    return np.asarray(np.linalg.norm(middles, axis=1))


def _shares(
    network: Network, solution: Solution, precision: Precision, by_photograph: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return relative changes of the focal length, and their probabilities by chance.

    Parameters
    ----------
    by_photograph : (k, v) array
        Relative change of each photograph's focal length by one unit of each of k changes.

    Returns
    -------
    shares : (k,) array
        Each estimated without the others; NaN: not determined.
    p_values : (k,) array
    """
    places = precision.places
    count = int(places.max()) + 1
    photographs = _reduced_rows(network, solution)
    coupling = np.zeros((len(by_photograph), len(precision.inverse)))
    for each, share in zip(photographs, by_photograph.T, strict=True):
        coupling[:, each.columns] += np.outer(share, each.shared.T @ each.by_focal)
    steps = coupling @ precision.inverse
    # (v, k): of each photograph's derivatives by a change, without what other unknowns take up
    squares = np.empty(by_photograph.T.shape)
    products = np.empty_like(squares)  # with its residuals
    for index, each in enumerate(photographs):
        own = np.outer(each.by_focal, by_photograph[:, index])
        own -= each.shared @ steps[:, each.columns].T
        squares[index] = np.sum(own**2, axis=0)
        products[index] = each.residuals @ own
    information = squares.sum(axis=0)
    is_determined = information > 0.0
    information[~is_determined] = np.nan
    shares = products.sum(axis=0) / information
    leverage = np.maximum(1.0 - squares / information, 0.1) ** REDUNDANCY_POWER
    pulls = (products - shares * squares) / leverage
    by_place = np.zeros((count, len(shares)))
    np.add.at(by_place, places, pulls)
    scatter = np.sum(by_place**2, axis=0) * count / (count - 1)
    sds = np.sqrt(np.maximum(scatter, precision.variance_factor * information)) / information
    return shares, np.asarray(2.0 * stats.t.sf(np.abs(shares) / sds, count - 2))


@dataclass(frozen=True, slots=True, eq=False)
class _ReducedRows:
    """Equations of one photograph without its pose."""

    by_focal: FloatArray  # (n,): derivatives by the relative change of its own focal length
    shared: FloatArray  # (n, m): derivatives by the unknowns that it shares with others
    columns: IndexArray  # (m,): numbers of these
    # (n,): of the minimum, in which the other unknowns have nothing left to explain
    residuals: FloatArray


def _reduced_rows(network: Network, solution: Solution) -> list[_ReducedRows]:
    parameters = len(network.model.names)
    found = []
    for view in view_rows(network, network_rows(network, solution.estimate, solution.weights)):
        column = _by_scale(network, solution.estimate, view)
        design = np.hstack((view.by_camera, column[:, None]))
        rows, left = without_pose(replace(view, by_camera=design))
        shared = np.delete(rows, parameters, axis=1)
        found.append(_ReducedRows(rows[:, parameters], shared, view.columns, left))
    return found


def _by_scale(network: Network, estimate: Estimate, view: ViewRows) -> FloatArray:
    """Return the derivatives (2m,) of a photograph by a relative change of fx and fy."""
    focal = [index for index, name in enumerate(network.model.names) if name in ("fx", "fy")]
    return np.asarray(view.by_camera[:, focal] @ estimate.cameras[0, focal])
