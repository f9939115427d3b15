"""Normal equations with the points eliminated, which is faster than eliminating the poses.

If no bar connects them, the points' normal equations consist of 3 × 3 blocks that are inverted one
by one. Cameras and poses remain, a few hundred unknowns at most. Eliminating the poses instead
would leave three unknowns for every point of the field.
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
    """Normal equations of cameras and poses, and the terms to compute the points from them."""

    normal: FloatArray  # (x, x): cameras, then of each photograph its pose and its bends
    right: FloatArray  # (x,)
    coupling: FloatArray  # (x, m, 3): to the points
    point_inverses: FloatArray  # (m, 3, 3)
    point_right: FloatArray  # (m, 3)


def can_eliminate_points(network: Network) -> bool:
    """Return whether the points' equations are separate regular blocks.

    They are if the points are unknowns with a prior each, and no bar connects them.
    """
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
    view_unknowns = 6 + network.bend_count
    size = cameras + view_unknowns * len(equations)
    normal, right = np.zeros((size, size)), np.zeros(size)
    camera_information = network.cameras.sd.ravel() ** -2.0
    normal[np.arange(cameras), np.arange(cameras)] = camera_information
    right[:cameras] = camera_information * (network.cameras.values - estimate.cameras).ravel()
    coupling = np.zeros((size, len(estimate.points), 3))
    blocks = information.copy()
    gaps = network.points.nominal - estimate.points
    point_right = np.einsum("nij,nj->ni", information, gaps)
    for index, view in enumerate(equations):
        if view.by_point is None:
            continue
        first = int(network.view_camera[index]) * parameters
        pose = cameras + view_unknowns * index + np.arange(view_unknowns)
        columns = np.concatenate((first + np.arange(parameters), pose))
        design = np.hstack((view.by_camera, view.by_pose))
        normal[np.ix_(columns, columns)] += design.T @ design
        right[columns] += design.T @ view.residuals
        normal[np.ix_(pose, pose)] += view.bend_rows.T @ view.bend_rows
        right[pose] += view.bend_rows.T @ view.bend_residuals
        count = len(view.rows)
        points = network.observations.point[view.rows]
        across = view.by_point.transpose(0, 2, 1)
        # a photograph shows a point at most once, so that `+=` adds all
        blocks[points] += across @ view.by_point
        residuals = view.residuals.reshape(count, 2, 1)
        point_right[points] += (across @ residuals)[:, :, 0]
        rows = design.reshape(count, 2, -1).transpose(0, 2, 1) @ view.by_point
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
    point_right = system.point_right - np.einsum("xmi,x->mi", system.coupling, step)
    points = estimate.points + np.einsum("mij,mj->mi", system.point_inverses, point_right)
    cameras = network.cameras.values.size
    return estimate.moved(
        step[:cameras], step[cameras:].reshape(len(estimate.rotations), -1), points
    )


def determined_by_priors(network: Network, system: PointReducedSystem) -> float:
    """Return how many unknowns the priors determine, as a sum of shares."""
    information = network.points.information
    if information is None:
        raise ValueError("the points are no unknowns")
    inverse = np.linalg.inv(system.normal)
    cameras = network.cameras.values.size
    determined = float(inverse.diagonal()[:cameras] @ network.cameras.sd.ravel() ** -2.0)
    if network.bends is not None:
        determined += float(np.sum(bend_cofactors_of(network, system))) / network.bends.sd**2
    carried = np.einsum("xmi,mij->mxj", system.coupling, system.point_inverses)
    cofactors = system.point_inverses + carried.transpose(0, 2, 1) @ (inverse @ carried)
    return determined + float(np.sum(cofactors * information))


def bend_cofactors_of(network: Network, system: PointReducedSystem) -> FloatArray:
    """Return the cofactors (v, b) of the bends, with all other unknowns estimated as well."""
    determined = np.linalg.inv(system.normal).diagonal()[network.cameras.values.size :]
    return np.asarray(determined.reshape(len(network.view_camera), -1)[:, 6:])
