"""Formal and clustered covariances of a network, and which parameters it cannot separate.

The formal covariance s₀² N⁻¹ assumes that the errors of all discs are independent. They are not: a
shutter, the light or a wrong model displaces all discs of a photograph. The test is to calibrate
from two halves of a set of photographs, and to compare their difference with its standard
deviation; the ratio should be 1. With formal standard deviations it is 2 to 7.

Therefore the covariance is estimated from the scatter between places, each with all its
photographs. Residuals are first divided by a power of their redundancy:

- Power 1/2 is CR2 of Bell & McCaffrey (2002), which still assumes that the discs of a photograph
  are independent. The ratio is 1.0 to 2.1.
- Power 1 is CR3, the jackknife. The ratio is 0.3 to 0.5 with three to five photographs, one of
  which dominates.

The power used here, `REDUNDANCY_POWER`, lies between the two.

Two corrections follow. Even with independent errors, the residuals so divided scatter more than the
parameters, by a known amount. And with few photographs, their scatter varies by chance. So only the
scatter in excess of independent errors is added to the formal covariance, shrunk by the amount that
chance explains (James & Stein). The alternative is to use the scatter itself, but never less than
the formal covariance. The ratios are then:

- Simulated photographs with independent errors, with the geometry of three published sets: 0.82
  (boof_regular), 0.88 (ros10) and 0.96 (dice_white); by the scatter itself 0.72, 0.79 and 0.66.
- Six published sets themselves: 0.81 (dice_white) to 1.26 (ros10); by the scatter itself 0.71 to
  1.34.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import linalg, optimize

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.bursts import place_numbers
from kgcp.network.equations import (
    ReducedSystem,
    ViewRows,
    bordered_by,
    inner_constraints,
    network_rows,
    prior_cost,
    prior_equations,
    reduce_poses,
    scales_of,
    view_rows,
    whitened,
)
from kgcp.network.point_elimination import (
    bend_cofactors_of,
    can_eliminate_points,
    determined_by_priors,
    reduce_points,
)
from kgcp.network.records import Network, Precision, Solution

REDUNDANCY_POWER = 0.75
# Smallest factor of the stated variances. Residuals of zero do not prove that the discs are exact.
_MIN_FACTOR = 1e-4
# Smallest redundancy of a direction in the space of the observations. Below, no other observation
# checks it, and its residual says nothing.
_MIN_REDUNDANCY = 1e-6


def precision(network: Network, solution: Solution) -> Precision:
    """Return how well an adjusted network determines its unknowns.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is not determined at all.
    """
    rows = network_rows(network, solution.estimate, solution.weights)
    system = reduce_poses(network, solution.estimate, rows)
    inverse, equations = _inverse(network, system), view_rows(network, rows)
    squares = float(np.sum(whitened(network, solution.residuals, solution.weights) ** 2))
    squares += prior_cost(network, solution.estimate)
    factor = squares / max(_degrees_of_freedom(network, solution.weights, len(inverse)), 1)
    places = place_numbers(network, solution.estimate)
    return Precision(
        factor,
        inverse,
        _pose_inverses(system, inverse)[:, :6, :6],
        _redundancy_numbers(equations, system, inverse, len(solution.weights)),
        _camera_covariance(network, _by_place(equations, places), inverse, factor),
        places,
    )


def fitting_covariances(network: Network, solution: Solution, stated: FloatArray) -> FloatArray:
    """Return covariances (n, 2, 2) of the discs that agree with their residuals.

    If the residuals are smaller than stated, all covariances are scaled. If they are larger, the
    same variance is added to all discs, because model errors do not depend on how well a disc was
    measured.

    Parameters
    ----------
    stated : (n, 2, 2) array
        Covariances that the disc operator states.
    """
    freedom = _observation_freedom(network, solution)
    values, vectors = np.linalg.eigh(stated)
    along = np.einsum("nij,ni->nj", vectors, solution.residuals)
    squares = along**2 * solution.weights[:, None]
    factor = float(np.sum(squares / values)) / freedom
    if factor <= 1.0:
        return np.asarray(max(factor, _MIN_FACTOR) * stated)

    def excess(added: float) -> float:
        return float(np.sum(squares / (values + added))) - freedom

    added = optimize.brentq(excess, 0.0, factor * float(values.max()), rtol=1e-9)
    return np.asarray(stated + added * np.eye(2))


def bend_cofactors(network: Network, solution: Solution) -> FloatArray:
    """Return the cofactors (v, b) of the bends, with all other unknowns estimated as well."""
    rows = network_rows(network, solution.estimate, solution.weights)
    if can_eliminate_points(network):
        reduced = reduce_points(network, solution.estimate, rows)
        return bend_cofactors_of(network, reduced)
    system = reduce_poses(network, solution.estimate, rows)
    return _bend_cofactors(system, _inverse(network, system))


def _observation_freedom(network: Network, solution: Solution) -> float:
    """Return the redundancy of the observations: their number minus that of unknowns.

    Unknowns count only by the share that the observations, not the priors, determine.
    """
    used = 2 * int(np.count_nonzero(solution.weights))
    by_observations = _unknown_count(network) - _determined_by_priors(network, solution)
    return max(used - by_observations - 6 * len(network.view_camera), 1.0)


def _unknown_count(network: Network) -> int:
    """Return the number of unknowns besides the poses."""
    points = 0 if network.points.is_fixed else network.points.nominal.size
    bends = network.bend_count * len(network.view_camera)
    return network.cameras.values.size + points + bends


def _determined_by_priors(network: Network, solution: Solution) -> float:
    """Return how many unknowns priors and inner constraints determine, as a sum of shares."""
    rows = network_rows(network, solution.estimate, solution.weights)
    if can_eliminate_points(network):
        return determined_by_priors(network, reduce_points(network, solution.estimate, rows))
    system = reduce_poses(network, solution.estimate, rows)
    inverse = _inverse(network, system)
    information, _ = prior_equations(network, solution.estimate, len(inverse))
    by_bends = 0.0
    if network.bends is not None:
        cofactors = _bend_cofactors(system, inverse)
        by_bends = float(np.sum(cofactors)) / network.bends.sd**2
    return float(np.sum(inverse * information)) + by_bends + network.points.datum_defect


def _degrees_of_freedom(network: Network, weights: FloatArray, unknowns: int) -> int:
    """Return the number of observations and priors minus that of unknowns."""
    used = 2 * int(np.count_nonzero(weights))
    priors = int(np.count_nonzero(np.isfinite(network.cameras.sd))) + len(network.points.bars)
    if network.points.information is not None:
        priors += int(np.linalg.matrix_rank(network.points.information).sum())
    if network.points.scale_row is not None:
        priors -= 1
    poses = 6 * len(network.view_camera)
    return used + priors + network.points.datum_defect - unknowns - poses


def _inverse(network: Network, system: ReducedSystem) -> FloatArray:
    """Return the inverse (u, u) of the reduced normal equations, under the inner constraints."""
    scale = scales_of(system.normal)
    scaled = system.normal * np.outer(scale, scale)
    if network.points.datum_defect == 0:
        inverse: FloatArray = linalg.cho_solve(linalg.cho_factor(scaled), np.eye(len(scale)))
    else:
        basis = inner_constraints(network, network.points.nominal) / scale.max()
        bordered = bordered_by(scaled, basis * scale[:, None])
        inverse = np.asarray(np.linalg.inv(bordered)[: len(scale), : len(scale)], dtype=np.float64)
    inverse = 0.5 * (inverse + inverse.T)
    return np.asarray(inverse * np.outer(scale, scale))


def _pose_inverses(system: ReducedSystem, inverse: FloatArray) -> FloatArray:
    """Return the cofactors (v, q, q) of poses and bends, with cameras and points estimated."""
    own = np.linalg.inv(system.pose_normals)
    back = own @ system.couplings.transpose(0, 2, 1)
    carried = (back.reshape(-1, len(inverse)) @ inverse).reshape(back.shape)
    return np.asarray(own + carried @ back.transpose(0, 2, 1))


def _bend_cofactors(system: ReducedSystem, inverse: FloatArray) -> FloatArray:
    """Return the cofactors (v, b) of the bends."""
    return np.diagonal(_pose_inverses(system, inverse), axis1=1, axis2=2)[:, 6:]


def _redundancy_numbers(
    equations: Sequence[ViewRows], system: ReducedSystem, inverse: FloatArray, count: int
) -> FloatArray:
    """Return the redundancy numbers (n,) of the discs, summed over both coordinates: 0…2."""
    redundancy = np.zeros(count)
    for view, normal in zip(equations, system.pose_normals, strict=True):
        projected, _ = without_pose(view)
        own = np.einsum("ij,jk,ik->i", view.by_pose, np.linalg.inv(normal), view.by_pose)
        shared = inverse[np.ix_(view.columns, view.columns)]
        projected = projected[: len(own)]
        leverage = own + np.einsum("ij,ij->i", projected @ shared, projected)
        redundancy[view.rows] = 2.0 - leverage.reshape(-1, 2).sum(axis=1)
    return redundancy


def _by_place(equations: Sequence[ViewRows], places: IndexArray) -> list[list[ViewRows]]:
    """Return the equations of the photographs, grouped by place."""
    groups: list[list[ViewRows]] = [[] for _ in range(int(places.max()) + 1)]
    for view, place in zip(equations, places.tolist(), strict=True):
        groups[place].append(view)
    return groups


def _camera_covariance(
    network: Network, places: Sequence[Sequence[ViewRows]], inverse: FloatArray, factor: float
) -> FloatArray:
    """Return the covariance (c p, c p) of the camera parameters: formal plus excess scatter.

    Priors contribute to the formal covariance, but not to the scatter between places.
    """
    cameras = network.cameras.values.size
    formal = factor * inverse[:cameras, :cameras]
    scale = np.sqrt(formal.diagonal())
    root = np.linalg.cholesky(formal / np.outer(scale, scale)) * scale[:, None]
    from_scores = np.linalg.solve(root, inverse[:cameras])
    pulls = [_pull(*_joined(views), from_scores, inverse, factor) for views in places]
    excess = excess_scatter(
        np.array([pull for pull, _ in pulls]), np.array([expected for _, expected in pulls])
    )
    result = root @ (np.eye(cameras) + excess) @ root.T
    return np.asarray(0.5 * (result + result.T))


def excess_scatter(pulls: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the scatter (c, c) of the places' pulls beyond that of independent errors.

    The scatter minus its expectation is a matrix. By chance alone its squared norm would be about
    Σ tr(E)² + tr(E²), the sum being over places with expected scatter E. The matrix is multiplied
    by 1 minus the ratio of this value to its actual squared norm (James & Stein), so that a large
    excess is hardly reduced. Directions in which places scatter less than expected count as zero.

    Parameters
    ----------
    pulls : (m, c) array
        Shift of the camera parameters by each place, in units of their formal standard deviations.
    expected : (m, c, c) array
        Covariances of the pulls if errors are independent.
    """
    excess = pulls.T @ pulls - expected.sum(axis=0)
    by_chance = np.sum(np.trace(expected, axis1=1, axis2=2) ** 2) + np.sum(expected**2)
    share = 1.0 - by_chance / max(float(np.sum(excess**2)), np.finfo(float).tiny)
    values, vectors = np.linalg.eigh(max(share, 0.0) * excess)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _joined(views: Sequence[ViewRows]) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return the equations of one place: derivatives (n, k), residuals (n,), columns (k,).

    Poses are eliminated; n is the number of rows of all its photographs.
    """
    parts = [without_pose(view) for view in views]
    residuals = np.concatenate([part for _, part in parts])
    columns = dict.fromkeys(np.concatenate([view.columns for view in views]).tolist())
    index = {column: number for number, column in enumerate(columns)}
    projected = np.zeros((len(residuals), len(columns)))
    first = 0
    for view, (rows, _) in zip(views, parts, strict=True):
        last = first + len(rows)
        projected[first:last, [index[column] for column in view.columns.tolist()]] = rows
        first = last
    return projected, residuals, np.array(list(columns))


def _pull(
    projected: FloatArray,
    residuals: FloatArray,
    columns: IndexArray,
    from_scores: FloatArray,
    inverse: FloatArray,
    factor: float,
) -> tuple[FloatArray, FloatArray]:
    """Return a place's pull at the camera parameters (c,) and its expected covariance (c, c).

    The pull is C Aᵀ (I - H)^-p r, with the derivatives A, the residuals r and the leverage H of the
    place, and the power p. C (c, u) turns scores Aᵀ r into steps of the camera parameters.
    Independent errors give residuals the covariance s₀² (I - H), and the pull the covariance
    s₀² C Aᵀ (I - H)^(1 - 2p) A Cᵀ.

    Powers are computed from the eigenvalues of H, in the smaller of two spaces: that of the
    observations, or that of the unknowns, where H is LᵀAᵀA L with the Cholesky factor L of the
    cofactors.
    """
    carried, shared = from_scores[:, columns], inverse[np.ix_(columns, columns)]
    if len(shared) < len(residuals):
        root = np.linalg.cholesky(shared)
        values, vectors = np.linalg.eigh(root.T @ (projected.T @ projected) @ root)
        along = vectors.T @ (root.T @ (projected.T @ residuals))
        carried, squares = np.linalg.solve(root, carried.T).T @ vectors, values
    else:
        values, vectors = np.linalg.eigh(projected @ shared @ projected.T)
        along = vectors.T @ residuals
        carried, squares = carried @ projected.T @ vectors, np.ones_like(values)
    is_checked = 1.0 - values > _MIN_REDUNDANCY
    carried, redundancy = carried[:, is_checked], 1.0 - values[is_checked]
    expected = factor * squares[is_checked] * redundancy ** (1.0 - 2.0 * REDUNDANCY_POWER)
    return (
        carried @ (along[is_checked] / redundancy**REDUNDANCY_POWER),
        (carried * expected) @ carried.T,
    )


def without_pose(view: ViewRows) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (2m + b, k) and residuals (2m + b,) with pose and bends eliminated.

    The last b rows are those of the bends' prior.
    """
    basis = np.linalg.qr(np.vstack((view.by_pose, view.bend_rows)))[0]
    dense, residuals = view.dense(), np.concatenate((view.residuals, view.bend_residuals))
    dense = np.vstack((dense, np.zeros((len(view.bend_rows), dense.shape[1]))))
    return dense - basis @ (basis.T @ dense), residuals - basis @ (basis.T @ residuals)


def tangled(names: Sequence[str], cov: FloatArray, max_inflation: float) -> tuple[str, ...]:
    """Return the parameters that cannot be separated; empty if all can.

    There are some if correlation inflates the variance of a parameter by more than `max_inflation`.
    They are those that dominate the eigenvector of the correlation matrix's smallest eigenvalue.
    """
    sd = np.sqrt(cov.diagonal())
    correlation = cov / np.outer(sd, sd)
    inflation = np.linalg.inv(correlation).diagonal()
    if inflation.max() <= max_inflation:
        return ()
    _, vectors = np.linalg.eigh(correlation)
    weakest = np.abs(vectors[:, 0])
    return tuple(
        name for name, part in zip(names, weakest, strict=True) if part > 0.3 * weakest.max()
    )
