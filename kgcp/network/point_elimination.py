"""Normal equations with the points eliminated, which is faster than eliminating the poses.

If no bar connects them, the points' normal equations consist of 3 × 3 blocks that are inverted one
by one. Cameras and poses remain, a few hundred unknowns at most. Eliminating the poses instead
would leave three unknowns for every point of the field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.network.equations import NetworkRows, PointNormals, solution_of
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
    network: Network, estimate: Estimate, rows: NetworkRows, damping: float = 0.0
) -> PointReducedSystem:
    """Return the equations of cameras and poses, damped as by `reduce_poses`."""
    information = network.points.information
    if information is None or rows.by_point is None:
        raise ValueError("the points are no unknowns")
    normals, rights = rows.normals()
    views, parameters, unknowns = len(normals), rows.parameters, rows.bend_rows.shape[1]
    cameras, count = network.cameras.values.size, len(estimate.points)
    size = cameras + unknowns * views
    normal, right = np.zeros((size, size)), np.zeros(size)
    camera_information = network.cameras.sd.ravel() ** -2.0
    normal[np.arange(cameras), np.arange(cameras)] = camera_information
    right[:cameras] = camera_information * (network.cameras.values - estimate.cameras).ravel()
    right[cameras:] = rights[:, parameters:].ravel()
    index = np.arange(views)
    poses = normal[cameras:, cameras:].reshape(views, unknowns, views, unknowns)
    poses[index, :, index, :] = normals[:, parameters:, parameters:]
    for camera in range(len(network.cameras.values)):
        by_camera = network.views_by(camera)
        own = slice(camera * parameters, (camera + 1) * parameters)
        normal[own, own] += normals[by_camera, :parameters, :parameters].sum(axis=0)
        right[own] += rights[by_camera, :parameters].sum(axis=0)
        across = normal[own, cameras:].reshape(parameters, views, unknowns)
        across[:, by_camera] = normals[by_camera, :parameters, parameters:].transpose(1, 0, 2)
    normal[cameras:, :cameras] = normal[:cameras, cameras:].T
    parts = PointNormals.of(network, rows, rows.by_point)
    coupling = np.zeros((size, count, 3))
    coupling[:cameras] = parts.by_camera.transpose(0, 3, 1, 2).reshape(cameras, count, 3)
    # a photograph shows a point at most once
    of_poses = coupling[cameras:].reshape(views, unknowns, count, 3)
    of_poses[rows.views, :, rows.points] = parts.by_pose.transpose(0, 2, 1)
    blocks = information + parts.squares
    gaps = network.points.nominal - estimate.points
    point_right = parts.right + np.einsum("nij,nj->ni", information, gaps)
    diagonal = np.arange(3)
    blocks[:, diagonal, diagonal] *= 1.0 + damping
    normal[np.diag_indices(size)] *= 1.0 + damping
    inverses = np.asarray(np.linalg.inv(blocks), dtype=np.float64)
    flat = np.matmul(coupling.transpose(1, 0, 2), inverses).transpose(1, 0, 2).reshape(size, -1)
    return PointReducedSystem(
        normal - flat @ coupling.reshape(size, -1).T,
        right - flat @ point_right.ravel(),
        coupling,
        inverses,
        point_right,
    )


def moved_by_points(network: Network, estimate: Estimate, system: PointReducedSystem) -> Estimate:
    """Return the estimate after the step that solves the equations."""
    step = solution_of(system.normal, system.right)
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
