"""Normal equations of a network: poses eliminated photograph by photograph (Schur complement)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from kgcp.geometry._jit import compiled
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
class NetworkRows:
    """Whitened observation equations of all v photographs, one photograph after the other.

    There are n discs, each with two rows as in `ViewRows`.
    """

    rows: IndexArray  # (n,): indices of the observations
    starts: IndexArray  # (v + 1,): the discs of photograph i are starts[i] to starts[i + 1] - 1
    points: IndexArray  # (n,): indices of the points
    design: FloatArray  # (2n, p + q): derivatives by the camera, then by the pose and the bends
    by_point: FloatArray | None  # (n, 2, 3); None: points are fixed
    residuals: FloatArray  # (2n,)
    bend_rows: FloatArray  # (b, q), as in `ViewRows`
    bend_residuals: FloatArray  # (v, b)

    @property
    def parameters(self) -> int:
        """Number p of the parameters of a camera."""
        return int(self.design.shape[1] - self.bend_rows.shape[1])

    @property
    def views(self) -> IndexArray:
        """Index of each disc's photograph (n,)."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def normals(self) -> tuple[FloatArray, FloatArray]:
        """Return each photograph's normal matrix (v, p + q, p + q) and right side (v, p + q).

        The unknowns are those of `design`; the prior of the bends is included.
        """
        count, unknowns = len(self.starts) - 1, self.design.shape[1]
        normals, rights = np.zeros((count, unknowns, unknowns)), np.zeros((count, unknowns))
        _add_products(self.design, self.residuals, self.starts, normals, rights)
        pose = self.parameters
        normals[:, pose:, pose:] += self.bend_rows.T @ self.bend_rows
        rights[:, pose:] += self.bend_residuals @ self.bend_rows
        return normals, rights


@compiled
def _add_products(
    design: FloatArray,
    residuals: FloatArray,
    starts: IndexArray,
    normals: FloatArray,
    rights: FloatArray,
) -> None:
    """Add the products of each photograph's rows to normal matrices (v, u, u) and right sides."""
    unknowns = design.shape[1]
    for view in range(len(normals)):
        normal, right = normals[view], rights[view]
        for row in range(2 * starts[view], 2 * starts[view + 1]):
            for i in range(unknowns):
                slope = design[row, i]
                right[i] += slope * residuals[row]
                for k in range(i + 1):
                    normal[i, k] += slope * design[row, k]
        for i in range(unknowns):
            for k in range(i):
                normal[k, i] = normal[i, k]


@dataclass(frozen=True, slots=True, eq=False)
class PointNormals:
    """Parts of the normal equations that belong to the points, from the observations alone."""

    squares: FloatArray  # (m, 3, 3): of each point
    right: FloatArray  # (m, 3)
    by_camera: FloatArray  # (c, m, 3, p): of each point and camera
    by_pose: FloatArray  # (n, 3, q): of each disc's point, and the pose of its photograph

    @classmethod
    def of(cls, network: Network, rows: NetworkRows, by_point: FloatArray) -> PointNormals:
        """Compute them; `by_point` (n, 2, 3) is that of the rows."""
        count, cameras = len(network.points.nominal), len(network.cameras.values)
        across = np.swapaxes(by_point, 1, 2)
        by_design = across @ rows.design.reshape(len(by_point), 2, -1)
        camera_of = network.view_camera[rows.views]
        by_camera = _sums(
            by_design[:, :, : rows.parameters], camera_of * count + rows.points, cameras * count
        )
        return cls(
            _sums(across @ by_point, rows.points, count),
            _sums((across @ rows.residuals.reshape(-1, 2, 1))[:, :, 0], rows.points, count),
            by_camera.reshape(cameras, count, 3, -1),
            by_design[:, :, rows.parameters :],
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReducedSystem:
    """Normal equations with the poses eliminated, and the terms to compute the poses from them."""

    normal: FloatArray  # (u, u): cameras, then points unless they are fixed
    right: FloatArray  # (u,)
    pose_normals: FloatArray  # (v, q, q): poses, then bends
    pose_rights: FloatArray  # (v, q)
    couplings: FloatArray  # (v, u, q)


def computed(network: Network, estimate: Estimate) -> FloatArray:
    """Return the computed places (n, 2) of the discs for the current values of all unknowns."""
    observed = network.observations
    rays = _camera_points(network, estimate)
    normalised = rays[:, :2] / rays[:, 2:]
    if len(estimate.cameras) == 1:
        return network.model.places(estimate.cameras[0], normalised)
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
    points = bent_points(network, estimate)
    _move_to_cameras(estimate.rotations, estimate.translations, observed.view, points)
    return points


@compiled
def _move_to_cameras(
    rotations: FloatArray, translations: FloatArray, view: IndexArray, points: FloatArray
) -> None:
    """Replace points (n, 3) in the field's frame by those in the frames of their cameras."""
    for i in range(len(points)):
        x, y, z = points[i]
        rotation, translation = rotations[view[i]], translations[view[i]]
        square = 0.0
        for axis in range(3):
            across = rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z
            points[i, axis] = across + translation[axis]
            square += points[i, axis] * points[i, axis]
        if abs(points[i, 2]) < _MIN_DEPTH * math.sqrt(square):
            points[i, 2] = _MIN_DEPTH


def whitened(network: Network, residuals: FloatArray, weights: FloatArray) -> FloatArray:
    """Return residuals (n, 2) in units of their standard deviations, times the root weights."""
    scaled = (network.observations.white @ residuals[:, :, None])[:, :, 0]
    return np.asarray(scaled * np.sqrt(weights)[:, None])


def weighted_squares(network: Network, places: FloatArray, weights: FloatArray) -> float:
    """Return the weighted sum of squares of the residuals at computed places (n, 2).

    It is not finite if a place is not.
    """
    observed = network.observations
    return float(_squares(observed.white, observed.places, places, weights))


@compiled
def _squares(
    white: FloatArray, observed: FloatArray, places: FloatArray, weights: FloatArray
) -> float:
    total = 0.0
    for i in range(len(places)):
        x, y = observed[i, 0] - places[i, 0], observed[i, 1] - places[i, 1]
        first = white[i, 0, 0] * x + white[i, 0, 1] * y
        second = white[i, 1, 0] * x + white[i, 1, 1] * y
        total += weights[i] * (first * first + second * second)
    return total


def network_rows(network: Network, estimate: Estimate, weights: FloatArray) -> NetworkRows:
    """Return the whitened equations of a network, linearised at an estimate.

    A pose changes as in `Pose.moved`: translation, and a left rotation vector in the camera frame.
    """
    observed, used = network.observations, np.flatnonzero(weights > 0.0)
    used = used[np.argsort(observed.view[used], kind="stable")]
    view_of, points = observed.view[used], observed.point[used]
    starts = np.searchsorted(view_of, np.arange(len(network.view_camera) + 1))
    rays = _camera_points(network, estimate)[used]
    image = _images(network, estimate, network.view_camera[view_of], rays)
    bend_rows, bend_residuals = _bend_rows(network, estimate)
    parameters = len(network.model.names)
    by_place = np.empty((len(used), 2, 3))
    design = np.empty((len(used), 2, parameters + bend_rows.shape[1]))
    residuals = np.empty((len(used), 2))
    _fill_in_rows(
        used,
        (observed.white, observed.places, np.sqrt(weights)),
        (rays, estimate.translations, view_of),
        (image.places, image.by_ray, image.by_parameter),
        (by_place, design, residuals),
    )
    by_point = None
    if network.bends is not None or not network.points.is_fixed:
        by_point = by_place @ estimate.rotations[view_of]
    if network.bends is not None and by_point is not None:
        shapes = network.bends.shapes[points][:, None, :]
        design[:, :, parameters + 6 :] = by_point[:, :, 2:] * shapes
    return NetworkRows(
        used,
        starts,
        points,
        design.reshape(2 * len(used), -1),
        None if network.points.is_fixed else by_point,
        residuals.ravel(),
        bend_rows,
        bend_residuals,
    )


@compiled
def _fill_in_rows(
    used: IndexArray,
    observed: tuple[FloatArray, FloatArray, FloatArray],
    seen: tuple[FloatArray, FloatArray, IndexArray],
    image: tuple[FloatArray, FloatArray, FloatArray],
    filled: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Fill in the whitened derivatives by places (n, 2, 3) and unknowns (n, 2, u), and residuals.

    Parameters
    ----------
    used : (n,) array
        The observations, of all those in `observed`: whitening, places and root weights.
    seen : tuple
        Their rays (n, 3), the translations (v, 3) and each one's photograph (n,).
    image : tuple
        The fields of `ImageSlopes`.
    """
    whites, places, root_weights = observed
    rays, translations, view_of = seen
    computed_places, by_ray, by_parameter = image
    by_place, design, residuals = filled
    parameters = by_parameter.shape[2]
    for i in range(len(used)):
        white, root = whites[used[i]], root_weights[used[i]]
        x, y, z = rays[i]
        translation = translations[view_of[i]]
        arm_x, arm_y, arm_z = x - translation[0], y - translation[1], z - translation[2]
        gap_x = places[used[i], 0] - computed_places[i, 0]
        gap_y = places[used[i], 1] - computed_places[i, 1]
        for row in range(2):
            first, second = root * white[row, 0], root * white[row, 1]
            by_x = (first * by_ray[i, 0, 0] + second * by_ray[i, 1, 0]) / z
            by_y = (first * by_ray[i, 0, 1] + second * by_ray[i, 1, 1]) / z
            by_z = -(by_x * x + by_y * y) / z
            for k in range(parameters):
                design[i, row, k] = first * by_parameter[i, 0, k] + second * by_parameter[i, 1, k]
            by_place[i, row, 0], by_place[i, row, 1], by_place[i, row, 2] = by_x, by_y, by_z
            of_pose = design[i, row, parameters:]
            of_pose[0], of_pose[1], of_pose[2] = by_x, by_y, by_z
            # a rotation ω moves the point by ω × a, so that the row d changes by
            # d · (ω × a) = ω · (a × d)
            of_pose[3] = arm_y * by_z - arm_z * by_y
            of_pose[4] = arm_z * by_x - arm_x * by_z
            of_pose[5] = arm_x * by_y - arm_y * by_x
            residuals[i, row] = first * gap_x + second * gap_y


def view_rows(network: Network, rows: NetworkRows) -> list[ViewRows]:
    """Return the equations of every photograph."""
    parameters, first_point = rows.parameters, network.cameras.values.size
    equations = []
    for view, camera in enumerate(network.view_camera.tolist()):
        own = slice(rows.starts[view], rows.starts[view + 1])
        design = rows.design[2 * own.start : 2 * own.stop]
        columns = camera * parameters + np.arange(parameters)
        if rows.by_point is not None:
            of_points = first_point + 3 * rows.points[own, None] + np.arange(3)
            columns = np.concatenate((columns, of_points.ravel()))
        equations.append(
            ViewRows(
                rows.rows[own],
                columns,
                design[:, parameters:],
                design[:, :parameters],
                None if rows.by_point is None else rows.by_point[own],
                rows.residuals[2 * own.start : 2 * own.stop],
                rows.bend_rows,
                rows.bend_residuals[view],
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
    normalised = rays[:, :2] / rays[:, 2:]
    if len(estimate.cameras) == 1:
        return network.model.image(estimate.cameras[0], normalised)
    count, parameters = len(rays), len(network.model.names)
    images = ImageSlopes(
        np.empty((count, 2)), np.empty((count, 2, 2)), np.empty((count, 2, parameters))
    )
    for camera, values in enumerate(estimate.cameras):
        in_camera = cameras == camera
        image = network.model.image(values, normalised[in_camera])
        images.places[in_camera] = image.places
        images.by_ray[in_camera] = image.by_ray
        images.by_parameter[in_camera] = image.by_parameter
    return images


def reduce_poses(
    network: Network, estimate: Estimate, rows: NetworkRows, damping: float = 0.0
) -> ReducedSystem:
    """Return the normal equations of cameras and points, with the poses eliminated.

    Parameters
    ----------
    damping : float
        Levenberg-Marquardt: each diagonal element is increased by this share of itself.
    """
    parameters, cameras = rows.parameters, network.cameras.values.size
    size = cameras + (0 if rows.by_point is None else estimate.points.size)
    normal, right = prior_equations(network, estimate, size)
    normals, rights = rows.normals()
    couplings = np.zeros((len(normals), size, rows.bend_rows.shape[1]))
    for camera in range(len(network.cameras.values)):
        by_camera = network.views_by(camera)
        own = slice(camera * parameters, (camera + 1) * parameters)
        normal[own, own] += normals[by_camera, :parameters, :parameters].sum(axis=0)
        right[own] += rights[by_camera, :parameters].sum(axis=0)
        couplings[by_camera, own] = normals[by_camera, :parameters, parameters:]
    if rows.by_point is not None:
        count = len(estimate.points)
        parts = PointNormals.of(network, rows, rows.by_point)
        index = np.arange(count)
        blocks = normal[cameras:, cameras:].reshape(count, 3, count, 3)
        blocks[index, :, index, :] += parts.squares
        across = parts.by_camera.transpose(1, 2, 0, 3).reshape(3 * count, cameras)
        normal[cameras:, :cameras] += across
        normal[:cameras, cameras:] += across.T
        right[cameras:] += parts.right.ravel()
        # a photograph shows a point at most once
        of_points = couplings[:, cameras:].reshape(len(normals), count, 3, -1)
        of_points[rows.views, rows.points] = parts.by_pose
    diagonal = np.diag_indices(size)
    pose = np.arange(parameters, normals.shape[1])
    normals[:, pose, pose] *= 1.0 + damping
    pose_normals, pose_rights = normals[:, parameters:, parameters:], rights[:, parameters:]
    back = np.linalg.solve(pose_normals, couplings.transpose(0, 2, 1)).reshape(-1, size)
    normal[diagonal] *= 1.0 + damping
    normal -= couplings.transpose(1, 0, 2).reshape(size, -1) @ back
    right -= back.T @ pose_rights.ravel()
    return ReducedSystem(normal, right, pose_normals, pose_rights, couplings)


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
    rights = system.pose_rights - step @ system.couplings
    poses = np.asarray(np.linalg.solve(system.pose_normals, rights[:, :, None])[:, :, 0])
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


def solution_of(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Return the unknowns (u,) that solve normal equations (u, u) with a right side (u,).

    Raises
    ------
    numpy.linalg.LinAlgError
        If an unknown is not determined.
    """
    scale = scales_of(normal)
    _, solved, problem = lapack.dposv(normal * np.outer(scale, scale), scale * right)
    if problem:
        raise np.linalg.LinAlgError("the unknowns are not determined")
    return np.asarray(scale * solved)


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


def _sums(values: FloatArray, groups: IndexArray, count: int) -> FloatArray:
    """Return the sums (count, ...) of values (n, ...) that are in the same group (n,)."""
    flat = values.reshape(len(values), -1)
    width = flat.shape[1]
    index = groups[:, None] * width + np.arange(width)
    sums = np.bincount(index.ravel(), flat.ravel(), count * width)
    return np.asarray(sums.reshape(count, *values.shape[1:]))
