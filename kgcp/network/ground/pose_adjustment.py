"""The pose of one frame by least squares, with its covariance.

Some errors are those of all points together: distances may be too long by one factor (prints, focal
length), and a rolling shutter's camera moves from row to row. They are unknowns with an a-priori
deviation, and are eliminated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
_HIDDEN_BY_ROUNDING = 1e-9  # … and one that need not be tried
_ENDS_SD, _LEAST_RISE = 3.0, 0.5  # where a bend ends, and how much of χ² must rise until there
_NO_DISTANCE = 1e6  # deviation of the logarithm of a distance that is not measured
_DOUBTED_CHI2 = 9.0  # of a point that counts half for what all points have in common
_COMMON_ROUNDS = 5  # of its reweighting
_LEAST_MOTION_RAD_S = (
    1e-6  # of the deviation of a motion: 0, as a file may state it, has no inverse
)


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """Observations of n points near a pose."""

    # (n, 3): observed minus computed places [px] and logarithms of distances, NaN where they are
    # not measured; what is known of the camera's motion is taken off
    residuals: FloatArray
    design: FloatArray  # (n, 3, 7): derivatives by the pose's step
    by_point: FloatArray  # (n, 3, 3): … by the points' positions
    common: FloatArray  # (n, 3, k): … by what all points have in common
    precisions: FloatArray  # (k,): inverse a-priori variances of that


def _linearised(camera: Camera, images: PointImages, pose: CameraPose) -> _Linearised:
    """Return observations near a pose; points behind the camera have no residual."""
    residuals = _residuals(camera, images, pose)
    design, by_point = _design(camera, images, pose)
    parts, sds = [], []
    if images.sd_scale:
        of_distance = np.zeros((len(images), 3, 1))
        of_distance[:, 2] = 1.0
        parts.append(of_distance)
        sds += [images.sd_scale]
    if images.readout is not None:
        # the camera moves on from its pose: a shift and a turn, each in proportion to the delay
        by_motion = images.readout.delay_s[:, None, None] * design[:, :, :6]
        parts.append(by_motion)
        rotation = images.readout.rotation
        sight_m = np.linalg.norm(images.positions_m - pose.centre_m, axis=1)
        sd_rad_s = max(rotation.sd_rad_s, _LEAST_MOTION_RAD_S)
        sds += [sd_rad_s * float(sight_m.mean())] * 3 + [sd_rad_s] * 3
        # where the scene turns one way, the camera turns the other way
        turn = -pose.world_from_camera @ np.array(rotation.velocity_rad_s)
        residuals = residuals - by_motion[:, :, 3:] @ turn
    common = np.concatenate(parts, axis=2) if parts else np.zeros((len(images), 3, 0))
    return _Linearised(residuals, design, by_point, common, np.array(sds) ** -2.0)


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
    ahead = _is_ahead(images, pose)
    chi2 = np.full(len(images), np.inf)
    if ahead.any():
        kept = images.chosen(ahead)
        near = _linearised(camera, kept, pose)
        cov = _covariances(kept, near.by_point)
        cov[:, :2, :2] += slack_px**2 * np.eye(2)
        chi2[ahead] = _chi2(near.residuals - near.common @ _in_common(kept, near, cov), cov)
    return chi2


def _is_ahead(images: PointImages, pose: CameraPose) -> BoolArray:
    """Return which points (n,) are in front of the camera."""
    return np.asarray(pose.in_camera(images.positions_m)[:, 2] > 0.0)


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
            if float(step @ right) <= _HIDDEN_BY_ROUNDING:  # no step gains more
                return pose
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
    unknowns = 7 if sd_focal else 6
    if not _is_ahead(images, pose).all():
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    near = _linearised(camera, images, pose)
    known = np.nan_to_num(near.residuals)[..., None]
    both = np.concatenate((near.design[:, :, :unknowns], known, near.common), axis=2)
    cov = _covariances(images, near.by_point)
    try:
        weighted = weights[:, None, None] * np.linalg.solve(cov, both)
    except np.linalg.LinAlgError:  # a step to where a point is in the camera
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    square = np.einsum("nmp,nmq->pq", both, weighted)
    square = _without_common(square, near.precisions)
    normal, right = square[:unknowns, :unknowns], square[:unknowns, unknowns]
    cost = float(square[unknowns, unknowns])
    if sd_focal:
        off = math.log(pose.focal_scale)
        normal[6, 6] += 1.0 / sd_focal**2
        right[6] -= off / sd_focal**2
        cost += (off / sd_focal) ** 2
    return normal, right, cost


def _without_common(square: FloatArray, precisions: FloatArray) -> FloatArray:
    """Return products of columns without the last k, which are unknowns that are eliminated."""
    kept = len(square) - len(precisions)
    own = square[kept:, kept:] + np.diag(precisions)
    return np.asarray(
        square[:kept, :kept] - square[:kept, kept:] @ np.linalg.solve(own, square[kept:, :kept])
    )


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
    if not _is_ahead(images, pose).all():
        return None
    near = _linearised(camera, images, pose)
    exact = replace(images, position_cov=np.zeros_like(images.position_cov))
    unknowns = 7 if sd_focal else 6
    off = np.nan_to_num(near.residuals)[..., None]
    both = np.concatenate(
        (_by_positions(near), off, near.design[:, :, :unknowns], near.common), axis=2
    )
    square = np.einsum(
        "nmp,nmq->pq", both, np.linalg.solve(_covariances(exact, near.by_point), both)
    )
    of_pose = np.zeros(unknowns)
    if sd_focal:
        of_pose[6] = 1.0 / sd_focal**2
    try:
        reduced = _without_common(square, np.concatenate((of_pose, near.precisions)))
    except np.linalg.LinAlgError:
        return None
    return reduced[:-1, :-1], reduced[:-1, -1], float(reduced[-1, -1])


def _by_positions(near: _Linearised) -> FloatArray:
    """Return the derivatives (n, 3, 3 n) of all observations by all positions."""
    count = len(near.by_point)
    by_position = np.zeros((count, 3, count, 3))
    by_position[np.arange(count), :, np.arange(count)] = near.by_point
    return by_position.reshape(count, 3, 3 * count)


def position_slopes(
    camera: Camera, images: PointImages, pose: CameraPose, sd_focal: float
) -> FloatArray:
    """Return how an adjusted pose follows its points' positions.

    Returns
    -------
    (6, n, 3) or (7, n, 3) array
        Derivatives of the pose's step by the positions.
    """
    near = _linearised(camera, images, pose)
    unknowns = 7 if sd_focal else 6
    both = np.concatenate((near.design[:, :, :unknowns], -_by_positions(near), near.common), axis=2)
    weighted = np.linalg.solve(_covariances(images, near.by_point), both)
    reduced = _without_common(np.einsum("nmp,nmq->pq", both, weighted), near.precisions)
    normal, by_positions = reduced[:unknowns, :unknowns], reduced[:unknowns, unknowns:]
    if sd_focal:
        normal[6, 6] += 1.0 / sd_focal**2
    return np.asarray(np.linalg.solve(normal, by_positions)).reshape(unknowns, len(images), 3)


def scale_at(camera: Camera, images: PointImages, pose: CameraPose) -> float:
    """Return the logarithm of what all distances are too long by, alike; 0: they are not."""
    return float(common_at(camera, images, pose)[0][0]) if images.sd_scale else 0.0


def common_at(camera: Camera, images: PointImages, pose: CameraPose) -> tuple[FloatArray, float]:
    """Return what all points have in common (k,), and its squares over a-priori variances.

    First what all distances are too long by, if that is unknown; then how the camera moves during
    the readout, if that is.
    """
    near = _linearised(camera, images, pose)
    amounts = _in_common(images, near, _covariances(images, near.by_point))
    return amounts, float(near.precisions @ amounts**2)


def _in_common(images: PointImages, near: _Linearised, cov: FloatArray) -> FloatArray:
    """Return what all points have in common (k,), from their residuals.

    Points with wrong names hardly count.
    """
    scale = [_scale(images, near.residuals, cov)] if images.sd_scale else []
    amounts = np.zeros(len(near.precisions))
    amounts[: len(scale)] = scale
    if images.readout is None:
        return amounts
    # before anything is known of the motion, points may be off by all that it does
    spread = near.common / np.sqrt(near.precisions)
    wide = cov + spread @ np.swapaxes(spread, 1, 2)
    known = np.nan_to_num(near.residuals)
    both = np.concatenate((near.common, known[..., None]), axis=2)
    products = np.swapaxes(near.common, 1, 2) @ np.linalg.solve(cov, both)
    for stated in (wide, *[cov] * _COMMON_ROUNDS):
        chi2 = _chi2(near.residuals - near.common @ amounts, stated)
        weights = 1.0 / (1.0 + chi2 / _DOUBTED_CHI2)
        normal = np.einsum("n,npq->pq", weights, products)
        amounts = np.linalg.solve(normal[:, :-1] + np.diag(near.precisions), normal[:, -1])
    return np.asarray(amounts)


def _scale(images: PointImages, residuals: FloatArray, cov: FloatArray) -> float:
    """Return the logarithm by which all distances are too long, from residuals (n, 3).

    Points with wrong names hardly count: residuals far from the median have little weight.
    """
    known = images.has_distance & np.isfinite(residuals).all(axis=1)
    if not known.any():
        return 0.0
    logs, variances = residuals[known, 2], cov[known, 2, 2]
    off = (logs - np.median(logs)) ** 2 / variances
    weights = 1.0 / (variances * (1.0 + off / _DOUBTED_CHI2))
    return float(weights @ logs / (weights.sum() + images.sd_scale**-2.0))


def covariance_and_residuals(
    camera: Camera, images: PointImages, pose: CameraPose, used: BoolArray, sd_focal: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return covariance, residuals and their squares; None: the pose is not determined.

    Residuals are those to the pose and to its motion, but not to what distances are too long by.
    """
    kept = images.chosen(used)
    normal, _, _ = _normal_equations(camera, kept, pose, np.ones(len(kept)), sd_focal)
    scale = 1.0 / np.sqrt(np.diag(normal))
    unit = normal * np.outer(scale, scale)
    if not np.linalg.cond(unit) < 1e13:
        return None
    cov = np.linalg.inv(unit) * np.outer(scale, scale)
    chi2 = squared_residuals(camera, images, pose, 0.0)
    residuals = _residuals(camera, images, pose)
    if images.readout is not None:
        near = _linearised(camera, images, pose)
        amounts, _ = common_at(camera, kept, pose)
        residuals = near.residuals - near.common[:, :, -6:] @ amounts[-6:]
    return 0.5 * (cov + cov.T), residuals, chi2


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
