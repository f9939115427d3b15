"""Normal equations of a network: poses eliminated photograph by photograph (Schur complement)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.records import Estimate, ImageSlopes, Network, PointPrior, ScaleBar

# Smallest depth of a point, relative to its distance. A point in the plane through the projection
# centre parallel to the image has no image.
_MIN_DEPTH = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class ViewRows:
    """Whitened observation equations of one photograph with m discs.

    x and y of each disc are multiplied by the inverse Cholesky factor of its covariance and by the
    root of its weight, so that rows are in units of their standard deviation.
    """

    rows: IndexArray  # (m,): indices of the observations
    columns: IndexArray  # (k,): indices among the reduced unknowns: camera, then points
    by_pose: FloatArray  # (2m, q): derivatives by the pose, then by the bends
    by_camera: FloatArray  # (2m, p)
    by_point: FloatArray | None  # (m, 2, 3): each disc by its own point; None: points are fixed
    residuals: FloatArray  # (2m,)
    # the bends' prior as further whitened rows: every bend is zero
    bend_rows: FloatArray  # (b, q): derivatives by pose and bends
    bend_residuals: FloatArray  # (b,)

    @property
    def pose_normal(self) -> FloatArray:
        """The normal matrix (q, q) of pose and bends."""
        return np.asarray(self.by_pose.T @ self.by_pose + self.bend_rows.T @ self.bend_rows)

    @property
    def pose_right(self) -> FloatArray:
        """The right side (q,) of pose and bends."""
        return np.asarray(self.by_pose.T @ self.residuals + self.bend_rows.T @ self.bend_residuals)

    def dense(self) -> FloatArray:
        """Return the derivatives (2m, k) by the reduced unknowns."""
        if self.by_point is None:
            return self.by_camera
        count = len(self.rows)
        blocks = np.zeros((count, 2, count, 3))
        index = np.arange(count)
        blocks[index, :, index, :] = self.by_point
        return np.hstack((self.by_camera, blocks.reshape(2 * count, 3 * count)))


@dataclass(frozen=True, slots=True, eq=False)
class ReducedSystem:
    """Normal equations with the poses eliminated, and the terms to compute the poses from them."""

    normal: FloatArray  # (u, u)
    right: FloatArray  # (u,)
    pose_normals: FloatArray  # (v, q, q): poses, then bends
    pose_rights: FloatArray  # (v, q)
    couplings: tuple[FloatArray, ...]  # per photograph (k, q)
    columns: tuple[IndexArray, ...]  # per photograph (k,)


def computed(network: Network, estimate: Estimate) -> FloatArray:
    """Return the computed places (n, 2) of the discs for the current values of all unknowns."""
    observed = network.observations
    rays = _camera_points(network, estimate)
    normalised = rays[:, :2] / rays[:, 2:]
    places = np.empty_like(observed.places)
    cameras = network.view_camera[observed.view]
    for camera in range(len(estimate.cameras)):
        in_camera = cameras == camera
        places[in_camera] = network.model.places(estimate.cameras[camera], normalised[in_camera])
    return places


def bent_points(network: Network, estimate: Estimate) -> FloatArray:
    """Return the observed points (n, 3) on the field as bent in their photographs, field frame."""
    observed = network.observations
    points = np.asarray(estimate.points[observed.point])
    if network.bends is not None:
        shapes = network.bends.shapes[observed.point]
        points[:, 2] += np.sum(shapes * estimate.bends[observed.view], axis=1)
    return points


def _camera_points(network: Network, estimate: Estimate) -> FloatArray:
    """Return the observed points (n, 3) in the frames of their cameras."""
    observed = network.observations
    rotated = np.einsum(
        "nij,nj->ni", estimate.rotations[observed.view], bent_points(network, estimate)
    )
    points: FloatArray = rotated + estimate.translations[observed.view]
    is_flat = np.abs(points[:, 2]) < _MIN_DEPTH * np.linalg.norm(points, axis=1)
    points[is_flat, 2] = _MIN_DEPTH
    return points


def whitened(network: Network, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Return residuals (n, 2) in units of their standard deviations, times the root weights."""
    scaled = (network.observations.white @ residuals[:, :, None])[:, :, 0]
    return np.asarray(scaled * np.sqrt(weights)[:, None])


def view_rows(network: Network, estimate: Estimate, weights: FloatArray) -> list[ViewRows]:
    """Return the whitened equations of every photograph, linearised at an estimate.

    A pose changes as in `Pose.moved`: translation, and a left rotation vector in the camera frame.
    """
    observed, used = network.observations, np.flatnonzero(weights > 0.0)
    view_of = observed.view[used]
    rays = _camera_points(network, estimate)[used]
    image = _images(network, estimate, network.view_camera[view_of], rays)
    x, y, z = rays.T
    zero = np.zeros_like(x)
    ray_by_point = np.stack((1.0 / z, zero, -x / z**2, zero, 1.0 / z, -y / z**2), axis=1)
    by_place = image.by_ray @ ray_by_point.reshape(-1, 2, 3)
    by_rotation = -by_place @ _cross_matrices(rays - estimate.translations[view_of])
    white = observed.white[used] * np.sqrt(weights[used])[:, None, None]
    by_view = [by_place, by_rotation]
    if network.bends is not None:
        by_height = by_place @ estimate.rotations[view_of][:, :, 2:]
        by_view.append(by_height * network.bends.shapes[observed.point[used]][:, None, :])
    by_pose = white @ np.concatenate(by_view, axis=2)
    by_camera = white @ image.by_parameter
    residuals = white @ (observed.places[used] - image.places)[:, :, None]
    by_point = None
    if not network.points.is_fixed:
        by_point = white @ by_place @ estimate.rotations[view_of]
    parameters = len(network.model.names)
    first_point = network.cameras.values.size
    bend_rows, bend_residuals = _bend_rows(network, estimate)
    equations = []
    for view, camera in enumerate(network.view_camera.tolist()):
        in_view = np.flatnonzero(view_of == view)
        columns = camera * parameters + np.arange(parameters)
        if by_point is not None:
            points = first_point + 3 * observed.point[used[in_view]][:, None] + np.arange(3)
            columns = np.concatenate((columns, points.ravel()))
        equations.append(
            ViewRows(
                used[in_view],
                columns,
                by_pose[in_view].reshape(-1, bend_rows.shape[1]),
                by_camera[in_view].reshape(-1, parameters),
                None if by_point is None else by_point[in_view],
                residuals[in_view].ravel(),
                bend_rows,
                bend_residuals[view],
            )
        )
    return equations


def _bend_rows(network: Network, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the equations of the bends' prior (b, 6 + b), and each photograph's residuals."""
    if network.bends is None:
        return np.zeros((0, 6)), np.zeros((len(network.view_camera), 0))
    count = network.bend_count
    rows = np.hstack((np.zeros((count, 6)), np.eye(count))) / network.bends.sd
    return rows, -estimate.bends / network.bends.sd


def _images(
    network: Network, estimate: Estimate, cameras: IndexArray, rays: FloatArray
) -> ImageSlopes:
    """Return the images of points (n, 3) in their cameras (n,), with derivatives."""
    count, parameters = len(rays), len(network.model.names)
    images = ImageSlopes(
        np.empty((count, 2)), np.empty((count, 2, 2)), np.empty((count, 2, parameters))
    )
    normalised = rays[:, :2] / rays[:, 2:]
    for camera, values in enumerate(estimate.cameras):
        in_camera = cameras == camera
        image = network.model.image(values, normalised[in_camera])
        images.places[in_camera] = image.places
        images.by_ray[in_camera] = image.by_ray
        images.by_parameter[in_camera] = image.by_parameter
    return images


def reduce_poses(
    network: Network, estimate: Estimate, equations: list[ViewRows], damping: float = 0.0
) -> ReducedSystem:
    """Return the normal equations of cameras and points, with the poses eliminated.

    Parameters
    ----------
    damping : float
        Levenberg-Marquardt: each diagonal element is increased by this share of itself.
    """
    size = network.cameras.values.size
    if not network.points.is_fixed:
        size += estimate.points.size
    normal, right = prior_equations(network, estimate, size)
    diagonal = normal.diagonal().copy()
    pose_normals, pose_rights, couplings = [], [], []
    for view in equations:
        pose_normal, pose_right = view.pose_normal, view.pose_right
        pose_normal[np.diag_indices(len(pose_normal))] *= 1.0 + damping
        direct, coupling, direct_right = _unreduced(view)
        back = np.linalg.solve(pose_normal, coupling.T)
        normal[np.ix_(view.columns, view.columns)] += direct - coupling @ back
        right[view.columns] += direct_right - back.T @ pose_right
        diagonal[view.columns] += direct.diagonal()
        pose_normals.append(pose_normal)
        pose_rights.append(pose_right)
        couplings.append(coupling)
    normal[np.diag_indices(size)] += damping * diagonal
    return ReducedSystem(
        normal,
        right,
        np.array(pose_normals),
        np.array(pose_rights),
        tuple(couplings),
        tuple(view.columns for view in equations),
    )


def _unreduced(view: ViewRows) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a photograph's normal matrix (k, k), coupling to the pose (k, q), right side (k,)."""
    if view.by_point is None:
        design = view.by_camera
        return design.T @ design, design.T @ view.by_pose, design.T @ view.residuals
    parameters, count = view.by_camera.shape[1], len(view.rows)
    by_camera = view.by_camera.reshape(count, 2, parameters)
    by_pose = view.by_pose.reshape(count, 2, -1)
    residuals = view.residuals.reshape(count, 2)
    points = view.by_point.transpose(0, 2, 1)
    size = parameters + 3 * count
    direct = np.zeros((size, size))
    direct[:parameters, :parameters] = view.by_camera.T @ view.by_camera
    across = (points @ by_camera).reshape(3 * count, parameters)
    direct[parameters:, :parameters] = across
    direct[:parameters, parameters:] = across.T
    blocks = direct[parameters:, parameters:].reshape(count, 3, count, 3)
    index = np.arange(count)
    blocks[index, :, index, :] = points @ view.by_point
    coupling = np.vstack(
        (view.by_camera.T @ view.by_pose, (points @ by_pose).reshape(3 * count, -1))
    )
    right = np.concatenate(
        (view.by_camera.T @ view.residuals, (points @ residuals[:, :, None]).ravel())
    )
    return direct, coupling, right


def prior_equations(
    network: Network, estimate: Estimate, size: int
) -> tuple[FloatArray, FloatArray]:
    """Return the priors of cameras and points as normal equations."""
    normal, right = np.zeros((size, size)), np.zeros(size)
    information = network.cameras.sd.ravel() ** -2.0
    cameras = np.arange(network.cameras.values.size)
    normal[cameras, cameras] = information
    right[cameras] = information * (network.cameras.values - estimate.cameras).ravel()
    prior = network.points
    if prior.information is None:
        return normal, right
    first = len(cameras)
    index = np.arange(len(prior.nominal))
    blocks = normal[first:, first:].reshape(len(index), 3, len(index), 3)
    blocks[index, :, index, :] = prior.information
    gaps = prior.nominal - estimate.points
    right[first:] = np.einsum("nij,nj->ni", prior.information, gaps).ravel()
    row = prior.scale_row
    if row is not None:
        normal[first:, first:] -= np.outer(row, row)
        right[first:] -= row * float(row @ gaps.ravel())
    for bar in prior.bars:
        columns, slope, gap = _bar_row(bar, estimate.points, first)
        normal[np.ix_(columns, columns)] += np.outer(slope, slope)
        right[columns] += slope * gap
    return normal, right


def _bar_row(bar: ScaleBar, points: FloatArray, first: int) -> tuple[IndexArray, FloatArray, float]:
    across = points[bar.second] - points[bar.first]
    length = float(np.linalg.norm(across))
    columns = np.concatenate(
        [first + 3 * index + np.arange(3) for index in (bar.first, bar.second)]
    )
    slope = np.concatenate((-across, across)) / (length * bar.sd)
    return columns, slope, (bar.length - length) / bar.sd


def prior_cost(network: Network, estimate: Estimate) -> float:
    """Return the weighted squares of all priors' residuals: cameras, points, bars and bends."""
    cost = float(np.sum(((estimate.cameras - network.cameras.values) / network.cameras.sd) ** 2))
    prior: PointPrior = network.points
    if prior.information is not None:
        gaps = estimate.points - prior.nominal
        cost += float(np.einsum("ni,nij,nj->", gaps, prior.information, gaps))
        if prior.scale_row is not None:
            cost -= float(prior.scale_row @ gaps.ravel()) ** 2
        cost += sum(_bar_row(bar, estimate.points, 0)[2] ** 2 for bar in prior.bars)
    if network.bends is not None:
        cost += float(np.sum((estimate.bends / network.bends.sd) ** 2))
    return cost


def moved(
    network: Network, estimate: Estimate, system: ReducedSystem, step: FloatArray
) -> Estimate:
    """Return the estimate after a step (u,) of the reduced unknowns; the poses follow from it."""
    pose_steps = [
        np.linalg.solve(normal, right - coupling.T @ step[columns])
        for normal, right, coupling, columns in zip(
            system.pose_normals,
            system.pose_rights,
            system.couplings,
            system.columns,
            strict=True,
        )
    ]
    poses = np.array(pose_steps)
    cameras = estimate.cameras.size
    points = estimate.points
    if not network.points.is_fixed:
        points = points + step[cameras:].reshape(points.shape)
    return estimate.moved(step[:cameras], poses, points)


def inner_constraints(network: Network, points: FloatArray) -> FloatArray:
    """Return the inner constraints of a free network as orthonormal columns (u, d).

    They are the directions in which the whole field may move without changing any image: shift,
    rotation and, without a bar, scale of all points about their mean.
    """
    cameras = network.cameras.values.size
    defect = network.points.datum_defect
    centred = points - points.mean(axis=0)
    shifts = np.tile(np.eye(3), (len(points), 1))
    rotations = -_cross_matrices(centred).reshape(-1, 3)
    scale = centred.reshape(-1, 1)
    similarity = np.hstack((shifts, rotations, scale))[:, :defect]
    basis = np.zeros((cameras + points.size, defect))
    basis[cameras:] = np.linalg.qr(similarity)[0]
    return basis


def scales_of(normal: FloatArray) -> FloatArray:
    """Return the factors (u,) that scale the diagonal of normal equations (u, u) to ones.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is not determined: after elimination, its diagonal element is only rounding.
    """
    diagonal = normal.diagonal()
    if not np.all(diagonal > 0.0):
        raise np.linalg.LinAlgError("an unknown is not determined")
    return np.asarray(1.0 / np.sqrt(diagonal))


def bordered_by(normal: FloatArray, basis: FloatArray) -> FloatArray:
    """Return normal equations (u, u) bordered by constraints (u, d) on their unknowns."""
    corner = np.zeros((basis.shape[1],) * 2)
    return np.block([[normal, basis], [basis.T, corner]])


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """Return the cross-product matrices (n, 3, 3) of vectors (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1)
    return rows.reshape(-1, 3, 3)
