"""Normal equations with the points eliminated: for steps, where there are more points than poses.

The equations of points are blocks of three if no bar connects them, and each block is inverted by
itself. What remains are cameras and poses, some hundred unknowns at most, where eliminating the
poses would leave three for every point of the field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from kgcp.geometry.arrays import FloatArray
from kgcp.network.equations import ViewRows, scales_of
from kgcp.network.records import Estimate, Network


@dataclass(frozen=True, slots=True, eq=False)
class PointReducedSystem:
    """Normal equations of cameras and poses, and what brings the points back."""

    normal: FloatArray  # (x, x): cameras, then of each photograph its pose and its bends
    right: FloatArray  # (x,)
    coupling: FloatArray  # (x, m, 3): with the points
    point_inverses: FloatArray  # (m, 3, 3)
    point_right: FloatArray  # (m, 3)


def can_eliminate_points(network: Network) -> bool:
    """Return whether the equations of the points are blocks: free or stiff, without bars."""
    prior = network.points
    return not (prior.is_fixed or prior.bars or prior.datum_defect)


def reduce_points(
    network: Network, estimate: Estimate, equations: list[ViewRows], damping: float = 0.0
) -> PointReducedSystem:
    """Return the equations of cameras and poses, damped as by `reduce_poses`."""
    information = network.points.information
    if information is None:
        raise ValueError("the points are no unknowns")
    cameras, parameters = network.cameras.values.size, network.cameras.values.shape[1]
    own_count = 6 + network.bend_count
    size = cameras + own_count * len(equations)
    normal, right = np.zeros((size, size)), np.zeros(size)
    known = network.cameras.sd.ravel() ** -2.0
    normal[np.arange(cameras), np.arange(cameras)] = known
    right[:cameras] = known * (network.cameras.values - estimate.cameras).ravel()
    coupling = np.zeros((size, len(estimate.points), 3))
    blocks = information.copy()
    gaps = network.points.nominal - estimate.points
    point_right = np.einsum("nij,nj->ni", information, gaps)
    for index, view in enumerate(equations):
        if view.by_point is None:
            continue
        first = int(network.view_camera[index]) * parameters
        pose = cameras + own_count * index + np.arange(own_count)
        columns = np.concatenate((first + np.arange(parameters), pose))
        own = np.hstack((view.by_camera, view.by_pose))
        normal[np.ix_(columns, columns)] += own.T @ own
        right[columns] += own.T @ view.residuals
        normal[np.ix_(pose, pose)] += view.bend_rows.T @ view.bend_rows
        right[pose] += view.bend_rows.T @ view.bend_residuals
        count = len(view.rows)
        points = network.observations.point[view.rows]
        across = view.by_point.transpose(0, 2, 1)
        # a point is seen once in a photograph, so that plain indexing adds all
        blocks[points] += across @ view.by_point
        residuals = view.residuals.reshape(count, 2, 1)
        point_right[points] += (across @ residuals)[:, :, 0]
        rows = own.reshape(count, 2, -1).transpose(0, 2, 1) @ view.by_point
        coupling[np.ix_(columns, points)] += rows.transpose(1, 0, 2)
    diagonal = np.arange(3)
    blocks[:, diagonal, diagonal] *= 1.0 + damping
    normal[np.diag_indices(size)] *= 1.0 + damping
    inverses = np.asarray(np.linalg.inv(blocks), dtype=np.float64)
    carried = np.einsum("xmi,mij->xmj", coupling, inverses)
    flat = carried.reshape(size, -1)
    return PointReducedSystem(
        normal - flat @ coupling.reshape(size, -1).T,
        right - flat @ point_right.ravel(),
        coupling,
        inverses,
        point_right,
    )


def moved_by_points(network: Network, estimate: Estimate, system: PointReducedSystem) -> Estimate:
    """Return the estimate after the step that solves the equations."""
    scale = scales_of(system.normal)
    factor = linalg.cho_factor(system.normal * np.outer(scale, scale))
    step = scale * linalg.cho_solve(factor, scale * system.right)
    left = system.point_right - np.einsum("xmi,x->mi", system.coupling, step)
    points = estimate.points + np.einsum("mij,mj->mi", system.point_inverses, left)
    cameras = network.cameras.values.size
    return estimate.moved(
        step[:cameras], step[cameras:].reshape(len(estimate.rotations), -1), points
    )


def determined_by_priors(network: Network, system: PointReducedSystem) -> float:
    """Return how many of the unknowns the priors determine, as a sum of shares."""
    information = network.points.information
    if information is None:
        raise ValueError("the points are no unknowns")
    inverse = np.linalg.inv(system.normal)
    cameras = network.cameras.values.size
    by_cameras = float(inverse.diagonal()[:cameras] @ network.cameras.sd.ravel() ** -2.0)
    if network.bends is not None:
        by_cameras += float(np.sum(bend_cofactors_of(network, system))) / network.bends.sd**2
    carried = np.einsum("xmi,mij->mxj", system.coupling, system.point_inverses)
    cofactors = system.point_inverses + carried.transpose(0, 2, 1) @ (inverse @ carried)
    return by_cameras + float(np.sum(cofactors * information))


def bend_cofactors_of(network: Network, system: PointReducedSystem) -> FloatArray:
    """Return the cofactors (v, b) of the bends, all else unknown as well."""
    of_views = np.linalg.inv(system.normal).diagonal()[network.cameras.values.size :]
    return np.asarray(of_views.reshape(len(network.view_camera), -1)[:, 6:])
