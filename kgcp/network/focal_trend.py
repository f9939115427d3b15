"""Test whether the focal length changes with the distance of the field, as autofocus makes it.

If a lens is focused on the field, its image distance is longer than at infinity by its focal
length over the distance of the field, as a share. Poses take up most of such changes: in
photographs from 0.5 to 0.8 m by a lens of 8 mm with 2300 px, residuals of 0.014 px become 0.02 to
0.04 px. But the focal length is then that of the mean distance, and 1.3 % too long at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from kgcp.geometry.arrays import FloatArray
from kgcp.network.covariance import REDUNDANCY_POWER, without_pose
from kgcp.network.equations import ViewRows, view_rows
from kgcp.network.records import Estimate, Network, Precision, Solution

# With six or seven places, the scatter is known too badly: of 44 simulated sessions without a
# trend, two thirds of them of bending boards or with a rolling shutter, the only one with p < 0.001
# had six.
_MIN_PLACES = 8


@dataclass(frozen=True, slots=True)
class FocalTrend:
    """Change of the focal length with the distance, estimated beside all other unknowns."""

    # Relative change by the reciprocal of the distance. It is the lens's own focal length, if it is
    # focused on the field and none of its elements moves against the others.
    lens_m: float
    change_px: float  # of the focal length, from the farthest to the nearest photograph
    p_value: float  # probability of such a change by chance, from its scatter between places


def focal_trend(network: Network, solution: Solution, precision: Precision) -> FocalTrend | None:
    """Return how the focal length of one camera changes with the distance of the field.

    The trend is one further unknown of the linearised adjustment. All others are eliminated. Its
    standard deviation follows from the scatter between places, but is at least the formal one.

    Returns
    -------
    FocalTrend or None
        None if the photographs are from fewer than eight places, or all from one distance.
    """
    places = precision.places
    count = int(places.max()) + 1
    if count < _MIN_PLACES:
        return None
    closeness = 1.0 / _distances_m(solution.estimate)
    away = closeness - closeness.mean()
    trends, residuals = _rows_of_trend(network, solution, precision, away)
    squares = np.array([trend @ trend for trend in trends])
    information = float(squares.sum())
    if not information > 0.0:
        return None
    lens_m = sum(trend @ own for trend, own in zip(trends, residuals, strict=True)) / information
    pulls = (
        np.array(
            [trend @ (own - lens_m * trend) for trend, own in zip(trends, residuals, strict=True)]
        )
        / np.maximum(1.0 - squares / information, 0.1) ** REDUNDANCY_POWER
    )
    scatter = float(np.sum(np.bincount(places, pulls) ** 2)) * count / (count - 1)
    sd_m = np.sqrt(max(scatter, precision.variance_factor * information)) / information
    focal_px = float(solution.estimate.cameras[0, 0])
    return FocalTrend(
        float(lens_m),
        float(lens_m * np.ptp(closeness)) * focal_px,
        float(2.0 * stats.t.sf(abs(lens_m) / sd_m, count - 2)),
    )


def _distances_m(estimate: Estimate) -> FloatArray:
    """Return the distances (v,) between the cameras and the middle of the field [m]."""
    middles = estimate.rotations @ estimate.points.mean(axis=0) + estimate.translations
    return np.asarray(np.linalg.norm(middles, axis=1))


def _rows_of_trend(
    network: Network, solution: Solution, precision: Precision, away: FloatArray
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return each photograph's derivatives (n,) by the trend and its residuals (n,).

    All other unknowns are eliminated from the derivatives; in residuals of the minimum, they have
    nothing left to explain.
    """
    own: list[FloatArray] = []
    shared: list[FloatArray] = []
    residuals: list[FloatArray] = []
    coupling = np.zeros(len(precision.inverse))
    equations = view_rows(network, solution.estimate, solution.weights)
    parameters = len(network.model.names)
    for view, share in zip(equations, away.tolist(), strict=True):
        column = share * _by_scale(network, solution.estimate, view)
        design = np.hstack((view.by_camera, column[:, None]))
        rows, left = without_pose(replace(view, by_camera=design))
        own.append(rows[:, parameters])
        shared.append(np.delete(rows, parameters, axis=1))
        residuals.append(left)
        coupling[view.columns] += shared[-1].T @ own[-1]
    step = precision.inverse @ coupling
    trends = [
        trend - rows @ step[view.columns]
        for trend, rows, view in zip(own, shared, equations, strict=True)
    ]
    return trends, residuals


def _by_scale(network: Network, estimate: Estimate, view: ViewRows) -> FloatArray:
    """Return the derivatives (2m,) of a photograph by a relative change of fx and fy."""
    focal = [index for index, name in enumerate(network.model.names) if name in ("fx", "fy")]
    return np.asarray(view.by_camera[:, focal] @ estimate.cameras[0, focal])
