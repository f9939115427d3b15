"""The pose of one frame by least squares, with its covariance."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.camera import Camera
from kgcp.network.ground.point_images import CameraPose, PointImages

MOST_STEPS = 40
"""Of an adjustment."""

_CONVERGED = 1e-5  # decrease of χ² that means nothing
_ENDS_SD, _LEAST_RISE = 3.0, 0.5  # where a bend ends, and how much of χ² must rise until there
_NO_DISTANCE = 1e6  # deviation of the logarithm of a distance that is not measured


def _projected(
    camera: Camera, pose: CameraPose, points_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return pixels (n, 2), NaN behind the camera, and points in the camera frame (n, 3)."""
    points = pose.in_camera(points_m)
    depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
    return camera.distort(pose.focal_scale * points[:, :2] / depth[:, None]), points


def _residuals(camera: Camera, images: PointImages, pose: CameraPose) -> FloatArray:
    """Return observed minus computed places [px] and logarithms of distances (n, 3)."""
    pixels, points = _projected(camera, pose, images.positions_m)
    logs = np.log(images.distances_m * pose.focal_scale / np.linalg.norm(points, axis=1))
    return np.column_stack((images.pixels - pixels, logs))


def _design(camera: Camera, images: PointImages, pose: CameraPose) -> tuple[FloatArray, FloatArray]:
    """Return derivatives (n, 3, 7) by the pose's step and (n, 3, 3) by the points' positions.

    A distance by an image's size grows with the focal length; it belongs to the camera's own.
    """
    points = pose.in_camera(images.positions_m)
    normalised = pose.focal_scale * points[:, :2] / points[:, 2:]
    lens = camera.distort_jacobian(normalised)
    to_plane = np.zeros((len(images), 2, 3))
    to_plane[:, 0, 0] = to_plane[:, 1, 1] = pose.focal_scale
    to_plane[:, :, 2] = -normalised
    by_camera_point = np.empty((len(images), 3, 3))
    by_camera_point[:, :2] = lens @ (to_plane / points[:, 2, None, None])
    by_camera_point[:, 2] = points / np.sum(points**2, axis=1)[:, None]
    by_point = by_camera_point @ pose.world_from_camera.T
    by_focal = np.zeros((len(images), 3, 1))
    by_focal[:, :2, 0] = np.einsum("nij,nj->ni", lens, normalised)
    by_focal[:, 2, 0] = -1.0
    # with R' = exp(ω) R a point moves by (X − C) × ω in the world's axes
    by_turn = by_point @ cross_matrix(images.positions_m - pose.centre_m)
    return np.concatenate((-by_point, by_turn, by_focal), axis=2), by_point


def _covariances(images: PointImages, by_point: FloatArray) -> FloatArray:
    """Return the covariances (n, 3, 3) of the observations, those of the positions included."""
    cov = by_point @ images.position_cov @ np.swapaxes(by_point, 1, 2)
    cov[:, :2, :2] += images.pixel_cov
    known = images.has_distance
    cov[~known, 2, :] = cov[~known, :, 2] = 0.0
    cov[known, 2, 2] += (images.sd_distances_m[known] / images.distances_m[known]) ** 2
    cov[~known, 2, 2] = _NO_DISTANCE**2
    return np.asarray(cov)


def _chi2(residuals: FloatArray, cov: FloatArray) -> FloatArray:
    """Return squared residuals (n,) over covariances; infinite behind the camera."""
    behind = ~np.isfinite(residuals[:, 0])
    known = np.nan_to_num(residuals)
    squares = np.einsum("nm,nm->n", known, np.linalg.solve(cov, known[..., None])[..., 0])
    return np.asarray(np.where(behind, np.inf, squares))


def adjusted_pose(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> tuple[CameraPose, FloatArray, FloatArray] | None:
    """Return pose, covariance and residuals (n, 3) of an adjustment to all points.

    Parameters
    ----------
    start : CameraPose
        Near enough that all points lie in front of the camera.
    sd_focal : float
        As for `orient`.

    Returns
    -------
    tuple or None
        None: a point falls behind the camera, or the pose is not determined.
    """
    used = np.ones(len(images), dtype=np.bool_)
    pose = minimised(camera, images, start, used.astype(np.float64), sd_focal)
    result = (
        None if pose is None else covariance_and_residuals(camera, images, pose, used, sd_focal)
    )
    if pose is None or result is None:
        return None
    return pose, result[0], result[1]


def squared_residuals(
    camera: Camera, images: PointImages, pose: CameraPose, slack_px: float
) -> FloatArray:
    """Return squared residuals (n,) over their covariances; infinite behind the camera.

    Parameters
    ----------
    slack_px : float
        By which places may be off besides.
    """
    residuals = _residuals(camera, images, pose)
    ahead = np.isfinite(residuals[:, 0])
    chi2 = np.full(len(images), np.inf)
    if ahead.any():
        kept = images.chosen(ahead)
        _, by_point = _design(camera, kept, pose)
        cov = _covariances(kept, by_point)
        cov[:, :2, :2] += slack_px**2 * np.eye(2)
        off = residuals[ahead]
        off[:, 2] -= _scale(kept, off, cov)
        chi2[ahead] = _chi2(off, cov)
    return chi2


def minimised(
    camera: Camera,
    images: PointImages,
    start: CameraPose,
    weights: FloatArray,
    sd_focal: float,
    most_steps: int = MOST_STEPS,
    within: FloatArray | None = None,
) -> CameraPose | None:
    """Return the pose with the least weighted squares; None if a point falls behind the camera.

    Parameters
    ----------
    within : (6, k) or (7, k) array, optional
        Directions that steps may take; by default all.
    """
    counted = weights > 1e-9
    kept, weight = images.chosen(counted), weights[counted]
    if np.count_nonzero(counted) < 3:
        return None
    pose, damping = start, 1e-6
    normal, right, cost = _normal_equations(camera, kept, pose, weight, sd_focal)
    if not math.isfinite(cost):
        return None
    basis = np.eye(len(normal)) if within is None else within
    for _ in range(most_steps):
        scaled = basis / np.sqrt(np.maximum(np.diag(basis.T @ normal @ basis), 1e-300))
        unit = scaled.T @ normal @ scaled
        while True:
            damped = unit + damping * np.eye(len(unit))
            step = scaled @ np.linalg.solve(damped, scaled.T @ right)
            trial = pose.moved(step)
            trial_normal, trial_right, trial_cost = _normal_equations(
                camera, kept, trial, weight, sd_focal
            )
            if trial_cost < cost or damping > 1e6:
                break
            damping = max(10.0 * damping, 1e-6)
        if not trial_cost < cost:
            return pose
        is_done = cost - trial_cost <= _CONVERGED
        pose, normal, right, cost = trial, trial_normal, trial_right, trial_cost
        damping *= 0.1
        if is_done:
            break
    return pose


def _normal_equations(
    camera: Camera,
    images: PointImages,
    pose: CameraPose,
    weights: FloatArray,
    sd_focal: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Return normal matrix, right-hand side and weighted squares; the focal length if unknown."""
    residuals = _residuals(camera, images, pose)
    unknowns = 7 if sd_focal else 6
    if not np.isfinite(residuals[:, 0]).all():
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    design, by_point = _design(camera, images, pose)
    design, known = design[:, :, :unknowns], np.nan_to_num(residuals)
    cov = _covariances(images, by_point)
    try:
        solved = np.linalg.solve(cov, np.concatenate((design, known[..., None]), axis=2))
    except np.linalg.LinAlgError:  # a step to where a point is in the camera
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    weighted = weights[:, None, None] * solved
    normal = np.einsum("nmp,nmq->pq", design, weighted[..., :-1])
    right = np.einsum("nmp,nm->p", design, weighted[..., -1])
    cost = float(np.einsum("nm,nm->", known, weighted[..., -1]))
    if images.sd_scale:
        # what all distances are off by alike, as an unknown that is eliminated
        row = weighted[:, 2]
        coupling = row[:, :-1].sum(axis=0)
        pull = float(row[:, -1].sum())
        own = float(weights @ np.linalg.inv(cov)[:, 2, 2]) + images.sd_scale**-2.0
        normal -= np.outer(coupling, coupling) / own
        right -= coupling * pull / own
        cost -= pull**2 / own
    if sd_focal:
        off = math.log(pose.focal_scale)
        normal[6, 6] += 1.0 / sd_focal**2
        right[6] -= off / sd_focal**2
        cost += (off / sd_focal) ** 2
    return normal, right, cost


def position_equations(
    camera: Camera, images: PointImages, pose: CameraPose, sd_focal: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return normal equations of corrections to the points' positions, the pose eliminated.

    Parameters
    ----------
    images : PointImages
        Their `position_cov` does not count.
    pose : CameraPose
        Near the right one.
    sd_focal : float
        As for `orient`.

    Returns
    -------
    normal : (3 n, 3 n) array
        Singular: the whole can be shifted and turned.
    right : (3 n,) array
    squares : float
        Weighted squares of the residuals, without corrections.
        None instead of the three: a point is behind the camera, or the pose is not determined.
    """
    residuals = _residuals(camera, images, pose)
    if not np.isfinite(residuals[:, 0]).all():
        return None
    count = len(images)
    design, by_point = _design(camera, images, pose)
    weights = np.linalg.inv(_covariances(images, np.zeros_like(by_point)))
    unknowns = 7 if sd_focal else 6
    by_pose = np.zeros((count, 3, unknowns + 1))
    by_pose[:, :, :unknowns] = design[:, :, :unknowns]
    by_pose[:, 2, unknowns] = 1.0  # what all distances are too long by, alike
    prior = np.zeros(unknowns + 1)
    prior[unknowns] = 1.0 / max(images.sd_scale, 1e-9) ** 2
    if sd_focal:
        prior[6] = 1.0 / sd_focal**2
    by_position = np.zeros((count, 3, count, 3))
    by_position[np.arange(count), :, np.arange(count)] = by_point
    by_positions = by_position.reshape(count, 3, 3 * count)
    both = np.concatenate((by_pose, by_positions, np.nan_to_num(residuals)[..., None]), axis=2)
    square = np.einsum("nip,nij,njq->pq", both, weights, both)
    eliminated = unknowns + 1
    square[range(eliminated), range(eliminated)] += prior
    try:
        solved = np.linalg.solve(square[:eliminated, :eliminated], square[:eliminated, eliminated:])
    except np.linalg.LinAlgError:
        return None
    reduced = square[eliminated:, eliminated:] - square[eliminated:, :eliminated] @ solved
    return reduced[:-1, :-1], reduced[:-1, -1], float(reduced[-1, -1])


def scale_at(camera: Camera, images: PointImages, pose: CameraPose) -> float:
    """Return the logarithm of what all distances are too long by, alike; 0: they are not."""
    if not images.sd_scale:
        return 0.0
    _, by_point = _design(camera, images, pose)
    return _scale(images, _residuals(camera, images, pose), _covariances(images, by_point))


def _scale(images: PointImages, residuals: FloatArray, cov: FloatArray) -> float:
    """Return the logarithm by which all distances are too long, from residuals (n, 3).

    Points with wrong names hardly count: residuals far from the median have little weight.
    """
    known = images.has_distance & np.isfinite(residuals).all(axis=1)
    if not images.sd_scale or not known.any():
        return 0.0
    logs, variances = residuals[known, 2], cov[known, 2, 2]
    off = (logs - np.median(logs)) ** 2 / variances
    weights = 1.0 / (variances * (1.0 + off / 9.0))
    return float(weights @ logs / (weights.sum() + images.sd_scale**-2.0))


def covariance_and_residuals(
    camera: Camera, images: PointImages, pose: CameraPose, used: BoolArray, sd_focal: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return covariance, residuals and their squares; None: the pose is not determined."""
    kept = images.chosen(used)
    normal, _, _ = _normal_equations(camera, kept, pose, np.ones(len(kept)), sd_focal)
    scale = 1.0 / np.sqrt(np.diag(normal))
    unit = normal * np.outer(scale, scale)
    if not np.linalg.cond(unit) < 1e13:
        return None
    cov = np.linalg.inv(unit) * np.outer(scale, scale)
    chi2 = squared_residuals(camera, images, pose, 0.0)
    return 0.5 * (cov + cov.T), _residuals(camera, images, pose), chi2


def bend_cov(
    camera: Camera, images: PointImages, pose: CameraPose, cov: FloatArray, sd_focal: float
) -> FloatArray | None:
    """Return what a covariance of first order lacks, where one turn is hardly determined.

    Poses that are nearly as likely lie along a curve: at t standard deviations of that turn t d +
    t² q away, in first and second order. With a normal t the mean square of the second part is
    3 q qᵀ. The curve is followed to ± 3 standard deviations.

    Returns
    -------
    array or None
        None: at one of its ends there is no pose, or one that fits better than it should, as where
        the two poses of a plane that is seen from the front run into each other.
    """
    variances, axes = np.linalg.eigh(cov[3:6, 3:6])
    along = np.zeros(len(cov))
    along[3:6] = axes[:, -1]
    to_end = _ENDS_SD * cov @ along / math.sqrt(variances[-1])
    held = null_space(along[None])
    weights = np.ones(len(images))
    _, _, least = _normal_equations(camera, images, pose, weights, sd_focal)
    bend = np.zeros(len(cov))
    for step in (to_end, -to_end):
        there = minimised(camera, images, pose.moved(step), weights, sd_focal, within=held)
        if there is None:
            return None
        _, _, cost = _normal_equations(camera, images, there, weights, sd_focal)
        if cost - least < _LEAST_RISE * _ENDS_SD**2:
            return None
        bend += 0.5 * _step_between(pose, there, len(cov)) / _ENDS_SD**2
    return 3.0 * np.outer(bend, bend)


def _step_between(pose: CameraPose, other: CameraPose, unknowns: int) -> FloatArray:
    """Return the step that moves one pose to another: shift, left rotation, focal length."""
    turn = Rotation.from_matrix(other.world_from_camera @ pose.world_from_camera.T).as_rotvec()
    focal = math.log(other.focal_scale / pose.focal_scale)
    return np.array([*(other.centre_m - pose.centre_m), *turn, focal])[:unknowns]
