"""Formal and clustered covariances of a network, and which parameters it cannot tell apart.

The formal covariance s₀² N⁻¹ assumes that all discs are independent. They are not: whatever
distorts a photograph (a shutter, the light, a model that does not fit) displaces all its discs.
Halves of the same sets of photographs differ by 2 to 7 formal standard deviations. The covariance
is therefore estimated from the scatter between photographs, those of one place together, whose
residuals are divided by a power of their redundancy. CR2 of Bell & McCaffrey (2002), with the power
1/2, still assumes that the discs of a photograph are independent; halves differ by 1.0 to 2.1 of
its standard deviations. CR3, with the power 1, is the jackknife; with three to five photographs,
one of which dominates, halves differ by 0.3 to 0.5 of its standard deviations. The power used here
is between the two.

With independent errors, too, residuals over a power of their redundancy scatter more than the
parameters do, by an amount that is known, and few photographs scatter more or less by chance. So
only what they scatter in excess of independent errors, less what chance makes of none (James &
Stein), is added to the formal covariance. Halves of photographs with independent errors, from where
three published sets were taken, then differ by 0.82 (boof_regular), 0.88 (ros10) and 0.96
(dice_white) of their standard deviations; by the scatter itself, raised to the formal covariance
where it is smaller, by 0.72, 0.79 and 0.66. Halves of six sets themselves differ by 0.81
(dice_white) to 1.26 (ros10); by the scatter itself by 0.71 to 1.34.
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

_POWER = 0.75
_LEAST_FACTOR = 1e-4  # of the stated variances: residuals of zero prove nothing
_LEAST_REDUNDANCY = 1e-6  # of a direction of the observations: below, nothing else checks it


def precision(network: Network, solution: Solution) -> Precision:
    """Return how well an adjusted network determines its unknowns.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is not determined at all.
    """
    equations = view_rows(network, solution.estimate, solution.weights)
    system = reduce_poses(network, solution.estimate, equations)
    inverse = _inverse(network, system)
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

    If the residuals are smaller than `stated`, all covariances are scaled. If they are larger, the
    same variance is added to all discs: an effect that the model lacks does not depend on how well
    a disc was measured.

    Parameters
    ----------
    stated : (n, 2, 2) array
        Covariances as the discs were measured.
    """
    freedom = _observation_freedom(network, solution)
    values, vectors = np.linalg.eigh(stated)
    along = np.einsum("nij,ni->nj", vectors, solution.residuals)
    squares = along**2 * solution.weights[:, None]
    factor = float(np.sum(squares / values)) / freedom
    if factor <= 1.0:
        return np.asarray(max(factor, _LEAST_FACTOR) * stated)

    def excess(added: float) -> float:
        return float(np.sum(squares / (values + added))) - freedom

    added = optimize.brentq(excess, 0.0, factor * float(values.max()), rtol=1e-9)
    return np.asarray(stated + added * np.eye(2))


def bend_cofactors(network: Network, solution: Solution) -> FloatArray:
    """Return the cofactors (v, b) of the photographs' bends, all else unknown as well."""
    equations = view_rows(network, solution.estimate, solution.weights)
    if can_eliminate_points(network):
        reduced = reduce_points(network, solution.estimate, equations)
        return bend_cofactors_of(network, reduced)
    system = reduce_poses(network, solution.estimate, equations)
    return _bend_cofactors(system, _inverse(network, system))


def _observation_freedom(network: Network, solution: Solution) -> float:
    """Return how many observations there are beyond those that determine the unknowns."""
    used = 2 * int(np.count_nonzero(solution.weights))
    taken = _unknowns(network) - _determined_by_priors(network, solution)
    return max(used - taken - 6 * len(network.view_camera), 1.0)


def _unknowns(network: Network) -> int:
    """Return the number of unknowns besides the poses."""
    points = 0 if network.points.is_fixed else network.points.nominal.size
    bends = network.bend_count * len(network.view_camera)
    return network.cameras.values.size + points + bends


def _determined_by_priors(network: Network, solution: Solution) -> float:
    """Return the number of unknowns that priors and inner constraints determine, in shares."""
    equations = view_rows(network, solution.estimate, solution.weights)
    if can_eliminate_points(network):
        return determined_by_priors(network, reduce_points(network, solution.estimate, equations))
    system = reduce_poses(network, solution.estimate, equations)
    inverse = _inverse(network, system)
    information, _ = prior_equations(network, solution.estimate, len(inverse))
    by_bends = 0.0
    if network.bends is not None:
        cofactors = _bend_cofactors(system, inverse)
        by_bends = float(np.sum(cofactors)) / network.bends.sd**2
    return float(np.sum(inverse * information)) + by_bends + network.points.datum_defect


def _degrees_of_freedom(network: Network, weights: FloatArray, unknowns: int) -> int:
    """Return observations plus priors minus unknowns."""
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
    """Return the cofactors (v, q, q) of poses and bends, cameras and points unknown as well."""
    cofactors = []
    for normal, coupling, columns in zip(
        system.pose_normals, system.couplings, system.columns, strict=True
    ):
        own = np.linalg.inv(normal)
        back = own @ coupling.T
        cofactors.append(own + back @ inverse[np.ix_(columns, columns)] @ back.T)
    return np.array(cofactors)


def _bend_cofactors(system: ReducedSystem, inverse: FloatArray) -> FloatArray:
    """Return the cofactors (v, b) of the bends."""
    return np.diagonal(_pose_inverses(system, inverse), axis1=1, axis2=2)[:, 6:]


def _redundancy_numbers(
    equations: Sequence[ViewRows], system: ReducedSystem, inverse: FloatArray, count: int
) -> FloatArray:
    """Return the share (n,) of each disc's two coordinates that checks the others, 0…2."""
    redundancy = np.zeros(count)
    for view, normal in zip(equations, system.pose_normals, strict=True):
        projected, _ = _without_pose(view)
        own = np.einsum("ij,jk,ik->i", view.by_pose, np.linalg.inv(normal), view.by_pose)
        shared = inverse[np.ix_(view.columns, view.columns)]
        projected = projected[: len(own)]
        leverage = own + np.einsum("ij,ij->i", projected @ shared, projected)
        redundancy[view.rows] = 2.0 - leverage.reshape(-1, 2).sum(axis=1)
    return redundancy


def _by_place(equations: Sequence[ViewRows], places: IndexArray) -> list[list[ViewRows]]:
    """Return the equations of each place's photographs."""
    groups: list[list[ViewRows]] = [[] for _ in range(int(places.max()) + 1)]
    for view, place in zip(equations, places.tolist(), strict=True):
        groups[place].append(view)
    return groups


def _camera_covariance(
    network: Network, places: Sequence[Sequence[ViewRows]], inverse: FloatArray, factor: float
) -> FloatArray:
    """Return the covariance (c p, c p) of the camera parameters: formal, plus what places show.

    What priors contribute is part of the formal one, and does not scatter between places.
    """
    cameras = network.cameras.values.size
    formal = factor * inverse[:cameras, :cameras]
    scale = np.sqrt(formal.diagonal())
    root = np.linalg.cholesky(formal / np.outer(scale, scale)) * scale[:, None]
    in_formal = np.linalg.solve(root, inverse[:cameras])
    pulls = [_pull(*_together(views), in_formal, inverse, factor) for views in places]
    excess = beyond_independent(
        np.array([pull for pull, _ in pulls]), np.array([expected for _, expected in pulls])
    )
    result = root @ (np.eye(cameras) + excess) @ root.T
    return np.asarray(0.5 * (result + result.T))


def beyond_independent(pulls: FloatArray, expected: FloatArray) -> FloatArray:
    """Return how much more (c, c) the pulls of places scatter than independent errors make them.

    The scatter and what it is expected to be differ by a matrix whose squared norm chance makes
    about Σ tr(E)² + tr(E²) of places with expected scatters E. The difference counts by as much as
    its own squared norm exceeds that: large ones stay as they are (James & Stein). Directions in
    which places scatter less count as nothing.

    Parameters
    ----------
    pulls : (m, c) array
        By how much each place pulls at the camera parameters, in units of their formal deviations.
    expected : (m, c, c) array
        Covariances that independent errors give the pulls.
    """
    excess = pulls.T @ pulls - expected.sum(axis=0)
    by_chance = np.sum(np.trace(expected, axis1=1, axis2=2) ** 2) + np.sum(expected**2)
    share = 1.0 - by_chance / max(float(np.sum(excess**2)), np.finfo(float).tiny)
    values, vectors = np.linalg.eigh(max(share, 0.0) * excess)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _together(views: Sequence[ViewRows]) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Return the equations of a place: derivatives (n, k), residuals (n,), columns (k,).

    Poses are eliminated, and n is the number of rows of all photographs.
    """
    parts = [_without_pose(view) for view in views]
    residuals = np.concatenate([part for _, part in parts])
    columns = dict.fromkeys(np.concatenate([view.columns for view in views]).tolist())
    index = {column: at for at, column in enumerate(columns)}
    projected = np.zeros((len(residuals), len(columns)))
    first = 0
    for view, (own, _) in zip(views, parts, strict=True):
        last = first + len(own)
        projected[first:last, [index[column] for column in view.columns.tolist()]] = own
        first = last
    return projected, residuals, np.array(list(columns))


def _pull(
    projected: FloatArray,
    residuals: FloatArray,
    columns: IndexArray,
    in_formal: FloatArray,
    inverse: FloatArray,
    factor: float,
) -> tuple[FloatArray, FloatArray]:
    """Return a place's C Aᵀ (I - H)^-p r (c,) with the power p, and its expected covariance.

    C (c, u) makes steps of the camera of scores. Independent residuals have the covariance s₀² (I -
    H), so that of the result is s₀² C Aᵀ (I - H)^(1 - 2p) A Cᵀ. By the eigenvalues of H, in
    whichever space is smaller: that of the observations, or that of the unknowns, where H is
    LᵀAᵀA L with the Cholesky factor L of the cofactors.
    """
    carried, shared = in_formal[:, columns], inverse[np.ix_(columns, columns)]
    if len(shared) < len(residuals):
        root = np.linalg.cholesky(shared)
        values, vectors = np.linalg.eigh(root.T @ (projected.T @ projected) @ root)
        along = vectors.T @ (root.T @ (projected.T @ residuals))
        carried, squares = np.linalg.solve(root, carried.T).T @ vectors, values
    else:
        values, vectors = np.linalg.eigh(projected @ shared @ projected.T)
        along = vectors.T @ residuals
        carried, squares = carried @ projected.T @ vectors, np.ones_like(values)
    is_checked = 1.0 - values > _LEAST_REDUNDANCY  # what nothing else checks says nothing
    carried, redundancy = carried[:, is_checked], 1.0 - values[is_checked]
    expected = factor * squares[is_checked] * redundancy ** (1.0 - 2.0 * _POWER)
    return carried @ (along[is_checked] / redundancy**_POWER), (carried * expected) @ carried.T


def _without_pose(view: ViewRows) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (2m + b, k) and residuals without the part that the pose takes up.

    The last rows are those of the bends' prior.
    """
    basis = np.linalg.qr(np.vstack((view.by_pose, view.bend_rows)))[0]
    dense, residuals = view.dense(), np.concatenate((view.residuals, view.bend_residuals))
    dense = np.vstack((dense, np.zeros((len(view.bend_rows), dense.shape[1]))))
    return dense - basis @ (basis.T @ dense), residuals - basis @ (basis.T @ residuals)


def tangled(names: Sequence[str], cov: FloatArray, most_inflation: float) -> tuple[str, ...]:
    """Return the parameters that cannot be told apart, empty if all can.

    They are those of the weakest eigenvector of the correlation matrix, if the other parameters
    inflate the variance of one of them by more than `most_inflation`.
    """
    sd = np.sqrt(cov.diagonal())
    correlation = cov / np.outer(sd, sd)
    inflation = np.linalg.inv(correlation).diagonal()
    if inflation.max() <= most_inflation:
        return ()
    _, vectors = np.linalg.eigh(correlation)
    weakest = np.abs(vectors[:, 0])
    return tuple(
        name for name, part in zip(names, weakest, strict=True) if part > 0.3 * weakest.max()
    )
