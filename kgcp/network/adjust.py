"""Least-squares adjustment of a network, robust against discs that are not what they seem."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.network.equations import (
    ReducedSystem,
    ViewRows,
    bordered_by,
    computed,
    inner_constraints,
    moved,
    prior_cost,
    reduce_poses,
    scales_of,
    view_rows,
    whitened,
)
from kgcp.network.point_elimination import (
    can_eliminate_points,
    moved_by_points,
    reduce_points,
)
from kgcp.network.records import Estimate, Network, Solution

_FIRST_DAMPING = 1e-4
_MOST_DAMPING = 1e12
_CONVERGED = 1e-8  # relative decrease of the cost
_MOST_STEPS = 100
_ROUND_STEPS = 2  # between two reweightings, which change the minimum anyway
_SETTLED_WEIGHT = 0.05  # change of a weight between two rounds
_HUBER = 2.0  # in units of the robust deviation of a disc's residual
_MEDIAN_OF_TWO = math.sqrt(2.0 * math.log(2.0))  # of the norm of two standard normal numbers
_LEAST_DEVIATION = 0.1  # of the stated one: discs that fit better than that are no outliers
_ROUNDS = 12
# Discs of a photograph that are kept whatever their residuals: fewer might determine no pose.
_LEAST_DISCS, _LEAST_SHARE = 6, 1.0 / 3.0
_WORST_PHOTOGRAPH = 10.0  # deviation of its discs over that of all


@dataclass(frozen=True, slots=True)
class Robustness:
    """What is done about discs that do not fit.

    Attributes
    ----------
    is_huber : bool
        Whether residuals beyond twice the robust deviation count less.
    rejection : float
        Discs with residuals beyond this multiple of the robust deviation are rejected as a whole;
        infinite: none.
    """

    is_huber: bool = True
    rejection: float = 5.0


PLAIN = Robustness(is_huber=False, rejection=math.inf)
"""Least squares with all observations."""

ROBUST = Robustness()


def adjust_network(network: Network, start: Estimate, robustness: Robustness = ROBUST) -> Solution:
    """Adjust cameras, poses and points to the observed discs.

    Gauss-Newton with Levenberg's damping, in rounds of reweighting. The poses are eliminated
    photograph by photograph. A free network gets inner constraints.

    Parameters
    ----------
    start : Estimate
        Close enough that all points lie on their side of the camera.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is not determined at all, not even by a prior.
    """
    count = len(network.observations.view)
    weights, is_used = np.ones(count), np.ones(count, dtype=np.bool_)
    estimate = start
    if robustness != PLAIN:
        for _ in range(_ROUNDS):
            estimate = _minimise(network, estimate, weights, _ROUND_STEPS)
            next_weights, next_used = _reweighted(network, estimate, robustness)
            is_stable = np.array_equal(next_used, is_used) and np.allclose(
                next_weights, weights, atol=_SETTLED_WEIGHT
            )
            weights, is_used = next_weights, next_used
            if is_stable:
                break
    estimate = _minimise(network, estimate, weights, _MOST_STEPS)
    residuals = network.observations.places - computed(network, estimate)
    return Solution(estimate, residuals, is_used, weights)


def _minimise(
    network: Network, estimate: Estimate, weights: FloatArray, most_steps: int
) -> Estimate:
    """Return the estimate with the least weighted sum of squares."""
    damping = _FIRST_DAMPING
    cost = _cost(network, estimate, weights)
    for _ in range(most_steps):
        equations = view_rows(network, estimate, weights)
        while True:
            trial = _stepped(network, estimate, equations, damping)
            trial_cost = _cost(network, trial, weights)
            if trial_cost <= cost or damping > _MOST_DAMPING:
                break
            damping *= 10.0
        if trial_cost > cost:
            break
        is_done = cost - trial_cost <= _CONVERGED * cost
        estimate, cost = trial, trial_cost
        damping = max(damping / 10.0, 1e-15)
        if is_done:
            break
    return estimate


def _stepped(
    network: Network, estimate: Estimate, equations: list[ViewRows], damping: float
) -> Estimate:
    if can_eliminate_points(network):
        by_points = reduce_points(network, estimate, equations, damping)
        return moved_by_points(network, estimate, by_points)
    system = reduce_poses(network, estimate, equations, damping)
    return moved(network, estimate, system, _solved(network, estimate, system))


def _cost(network: Network, estimate: Estimate, weights: FloatArray) -> float:
    residuals = network.observations.places - computed(network, estimate)
    if not np.all(np.isfinite(residuals)):
        return math.inf
    return float(np.sum(whitened(network, residuals, weights) ** 2)) + prior_cost(network, estimate)


def _solved(network: Network, estimate: Estimate, system: ReducedSystem) -> FloatArray:
    """Return the step (u,); with inner constraints the field as a whole stays where it is."""
    scale = scales_of(system.normal)
    scaled = system.normal * np.outer(scale, scale)
    if network.points.datum_defect == 0:
        factor = linalg.cho_factor(scaled)
        return np.asarray(scale * linalg.cho_solve(factor, scale * system.right))
    basis = inner_constraints(network, network.points.nominal) / scale.max()
    bordered = bordered_by(scaled, basis * scale[:, None])
    first = network.cameras.values.size
    shift = (network.points.nominal - estimate.points).ravel()
    right = np.concatenate((scale * system.right, basis[first:].T @ shift))
    solved = linalg.solve(bordered, right, assume_a="sym")
    return np.asarray(scale * solved[: len(scale)])


def _reweighted(
    network: Network, estimate: Estimate, robustness: Robustness
) -> tuple[FloatArray, BoolArray]:
    """Return the weight of every disc, and which are kept: of a photograph always the best."""
    observations = network.observations
    residuals = observations.places - computed(network, estimate)
    sizes = np.linalg.norm(whitened(network, residuals, np.ones(len(residuals))), axis=1)
    # photographs fit differently well, so that discs are also compared within each of them
    overall = max(float(np.median(sizes)) / _MEDIAN_OF_TWO, _LEAST_DEVIATION)
    own = [
        float(np.median(sizes[observations.view == view])) / _MEDIAN_OF_TWO
        for view in range(len(network.view_camera))
    ]
    deviation = np.clip(own, overall, _WORST_PHOTOGRAPH * overall)[observations.view]
    limit = robustness.rejection * deviation
    is_used = sizes <= limit
    for view in range(len(network.view_camera)):
        mine = np.flatnonzero(observations.view == view)
        count = max(_LEAST_DISCS, math.ceil(_LEAST_SHARE * len(mine)))
        best = mine[np.argsort(sizes[mine], kind="stable")[:count]]
        is_used[best] = True
    weights = is_used.astype(np.float64)
    if robustness.is_huber:
        huber = _HUBER * deviation * math.sqrt(2.0)
        weights *= np.minimum(1.0, huber / np.maximum(sizes, np.finfo(float).tiny))
    return weights, is_used
