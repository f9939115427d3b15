"""Least-squares adjustment of a network, robust against misidentified or badly measured discs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.network.equations import (
    NetworkRows,
    ReducedSystem,
    bordered_by,
    computed,
    inner_constraints,
    moved,
    network_rows,
    prior_cost,
    reduce_poses,
    scales_of,
    solution_of,
    weighted_squares,
    whitened,
)
from kgcp.network.point_elimination import (
    can_eliminate_points,
    moved_by_points,
    reduce_points,
)
from kgcp.network.records import Estimate, Network, Solution

_FIRST_DAMPING = 1e-4
_MAX_DAMPING = 1e12
_CONVERGED = 1e-8  # relative decrease of the cost at which the iteration ends
_MAX_STEPS = 100
_ROUND_STEPS = 2  # steps per round of reweighting: the next weights move the minimum anyway
_MAX_ROUNDS = 12
_SETTLED_WEIGHT = 0.05  # weights that change by less between two rounds have settled
_HUBER = 2.0  # residual from which weights fall, in robust standard deviations
_MEDIAN_NORM = math.sqrt(2.0 * math.log(2.0))  # of two standard normal numbers
# Lower limit of the robust standard deviation, relative to the stated one. If all discs fit better
# than stated, none is an outlier.
_MIN_DEVIATION = 0.1
# The best-fitting discs of each photograph are kept whatever their residuals: at least this many,
# and at least this share. Fewer might not determine the pose.
_MIN_DISCS, _MIN_SHARE = 6, 1.0 / 3.0
# Upper limit of a photograph's own robust standard deviation, relative to that of all discs.
_MAX_PHOTOGRAPH_DEVIATION = 10.0


@dataclass(frozen=True, slots=True)
class Robustness:
    """Treatment of discs that do not fit.

    Attributes
    ----------
    is_huber : bool
        Whether residuals beyond twice the robust standard deviation are downweighted.
    rejection : float
        Limit of the residuals, as a multiple of the robust standard deviation. Discs beyond it are
        rejected, both coordinates together; infinite: none are.
    """

    is_huber: bool = True
    rejection: float = 5.0


PLAIN = Robustness(is_huber=False, rejection=math.inf)
"""Least squares with all observations."""

ROBUST = Robustness()


def adjust_network(network: Network, start: Estimate, robustness: Robustness = ROBUST) -> Solution:
    """Adjust cameras, poses and points to the observed discs.

    The method is Gauss-Newton with Levenberg's damping, in rounds of reweighting. Poses are
    eliminated photograph by photograph, or points one by one if that is possible. A free network
    gets inner constraints.

    Parameters
    ----------
    start : Estimate
        Approximate values; all points must lie in front of the cameras.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is determined neither by observations nor by a prior.
    """
    count = len(network.observations.view)
    weights, is_used = np.ones(count), np.ones(count, dtype=np.bool_)
    estimate = start
    if robustness != PLAIN:
        for _ in range(_MAX_ROUNDS):
            estimate = _minimise(network, estimate, weights, _ROUND_STEPS)
            next_weights, next_used = _reweighted(network, estimate, robustness)
            is_stable = np.array_equal(next_used, is_used) and np.allclose(
                next_weights, weights, atol=_SETTLED_WEIGHT
            )
            weights, is_used = next_weights, next_used
            if is_stable:
                break
    estimate = _minimise(network, estimate, weights, _MAX_STEPS)
    residuals = network.observations.places - computed(network, estimate)
    return Solution(estimate, residuals, is_used, weights)


def _minimise(
    network: Network, estimate: Estimate, weights: FloatArray, max_steps: int
) -> Estimate:
    """Return the estimate that minimises the weighted sum of squares."""
    damping = _FIRST_DAMPING
    cost = _cost(network, estimate, weights)
    for _ in range(max_steps):
        rows = network_rows(network, estimate, weights)
        while True:
            trial = _stepped(network, estimate, rows, damping)
            trial_cost = _cost(network, trial, weights)
            if trial_cost <= cost or damping > _MAX_DAMPING:
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


def _stepped(network: Network, estimate: Estimate, rows: NetworkRows, damping: float) -> Estimate:
    if can_eliminate_points(network):
        reduced = reduce_points(network, estimate, rows, damping)
        return moved_by_points(network, estimate, reduced)
    system = reduce_poses(network, estimate, rows, damping)
    return moved(network, estimate, system, _solved(network, estimate, system))


def _cost(network: Network, estimate: Estimate, weights: FloatArray) -> float:
    squares = weighted_squares(network, computed(network, estimate), weights)
    return squares + prior_cost(network, estimate) if math.isfinite(squares) else math.inf


def _solved(network: Network, estimate: Estimate, system: ReducedSystem) -> FloatArray:
    """Return the step (u,) of the reduced unknowns.

    Inner constraints keep the mean position, orientation and scale of the nominal points.
    """
    if network.points.datum_defect == 0:
        return solution_of(system.normal, system.right)
    scale = scales_of(system.normal)
    scaled = system.normal * np.outer(scale, scale)
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
    """Return the weight of every disc (n,) and whether it is kept (n,)."""
    observations = network.observations
    residuals = observations.places - computed(network, estimate)
    sizes = np.linalg.norm(whitened(network, residuals, np.ones(len(residuals))), axis=1)
    # Some photographs fit worse than others as a whole. A disc is an outlier only relative to its
    # own photograph.
    order = np.lexsort((sizes, observations.view))
    views, in_order = observations.view[order], sizes[order]
    starts = np.searchsorted(views, np.arange(len(network.view_camera) + 1))
    counts, starts = np.diff(starts), starts[:-1]
    medians = 0.5 * (in_order[starts + (counts - 1) // 2] + in_order[starts + counts // 2])
    overall = max(float(np.median(sizes)) / _MEDIAN_NORM, _MIN_DEVIATION)
    of_views = np.clip(medians / _MEDIAN_NORM, overall, _MAX_PHOTOGRAPH_DEVIATION * overall)
    deviation = of_views[observations.view]
    is_used = sizes <= robustness.rejection * deviation
    rank = np.arange(len(sizes)) - starts[views]
    is_used[order[rank < np.maximum(_MIN_DISCS, np.ceil(_MIN_SHARE * counts))[views]]] = True
    weights = is_used.astype(np.float64)
    if robustness.is_huber:
        huber = _HUBER * deviation * math.sqrt(2.0)
        weights *= np.minimum(1.0, huber / np.maximum(sizes, np.finfo(float).tiny))
    return weights, is_used
