"""The pose of one frame by least squares, with its covariance.

Some errors are common to all points: distances may have a wrong scale (prints, focal length), and
with a rolling shutter, the camera moves from row to row. These common errors are unknowns with
a-priori standard deviations, and are eliminated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.calibration import distort_jacobian_by_calibration
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.measurement.systematic_errors import pose_by_calibration
from kgcp.network.ground.point_equations import (
    add_products,
    fill_in_covariances,
    fill_in_derivatives,
    fill_in_residuals,
    fill_in_squares,
)
from kgcp.network.ground.point_images import CameraPose, PointImages

MAX_STEPS = 40
"""Steps of an adjustment."""

_CONVERGED = 1e-5  # decrease of χ² at which the iteration ends
_ROUNDING = 1e-9  # expected decrease of χ² below which no step is tried
# The curve of likely poses is followed to this many standard deviations on either side. At its
# ends, χ² must have risen by at least this share of the rise that the covariance predicts.
_CURVE_END_SD, _MIN_RISE = 3.0, 0.5
_HALF_WEIGHT_CHI2 = 9.0  # χ² of a point that has weight 1/2 in the common errors
_RING_SHARE = 0.01  # radius of a ring whose distance depends on the calibration, of the distance
_COMMON_ROUNDS = 5  # rounds of reweighting for the common errors
# Lower limit of a rotation rate's standard deviation. A file may state 0, which has no inverse.
_MIN_MOTION_SD_RAD_S = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """Observations of n points near a pose."""

    # (n, 3): observed minus computed places [px] and logarithms of distances (NaN: not measured),
    # corrected for the known motion of the camera
    residuals: FloatArray
    design: FloatArray  # (n, 3, 7): derivatives by the pose's step
    by_point: FloatArray  # (n, 3, 3): derivatives by the points' positions
    common: FloatArray  # (n, 3, k): derivatives by the common errors
    precisions: FloatArray  # (k,): inverse a-priori variances of the common errors


def _linearised(camera: Camera, images: PointImages, pose: CameraPose) -> _Linearised:
    """Return observations near a pose; points behind the camera have no residual."""
    points = pose.in_camera(images.positions_m)
    normalised = pose.focal_scale * points[:, :2] / points[:, 2:]
    residuals = _residuals_at(camera, images, pose, points, normalised)
    design, by_point = np.empty((len(images), 3, 7)), np.empty((len(images), 3, 3))
    fill_in_derivatives(
        points,
        normalised,
        camera.distort_jacobian(normalised),
        images.positions_m - pose.centre_m,
        np.ascontiguousarray(pose.world_from_camera),  # compiled once
        pose.focal_scale,
        design,
        by_point,
    )
    parts, sds = [], []
    if images.sd_scale:
        of_distance = np.zeros((len(images), 3, 1))
        of_distance[:, 2] = 1.0
        parts.append(of_distance)
        sds += [images.sd_scale]
    if images.readout is not None:
        # relative to its pose, the camera has moved and rotated in proportion to the delay
        by_motion = images.readout.delay_s[:, None, None] * design[:, :, :6]
        parts.append(by_motion)
        rotation = images.readout.motion.rotation
        sight_m = float(np.linalg.norm(images.positions_m - pose.centre_m, axis=1).mean())
        velocity = images.readout.velocity(sight_m)
        sds += [max(velocity.sd_m_s, sight_m * _MIN_MOTION_SD_RAD_S)] * 3
        sds += [max(rotation.sd_rad_s, _MIN_MOTION_SD_RAD_S)] * 3
        # the camera rotates opposite to the scene
        camera_rad_s = -pose.world_from_camera @ np.array(rotation.velocity_rad_s)
        residuals = residuals - by_motion @ np.concatenate((velocity.velocity_m_s, camera_rad_s))
    common = np.concatenate(parts, axis=2) if parts else np.zeros((len(images), 3, 0))
    return _Linearised(residuals, design, by_point, common, np.array(sds) ** -2.0)


def _residuals(camera: Camera, images: PointImages, pose: CameraPose) -> FloatArray:
    """Return observed minus computed places [px] and logarithms of distances (n, 3)."""
    points = pose.in_camera(images.positions_m)
    normalised = pose.focal_scale * points[:, :2] / points[:, 2:]
    return _residuals_at(camera, images, pose, points, normalised)


def _residuals_at(
    camera: Camera,
    images: PointImages,
    pose: CameraPose,
    points: FloatArray,
    normalised: FloatArray,
) -> FloatArray:
    """Return `_residuals` for points in the camera frame (n, 3) and their images (n, 2).

    A measured distance is proportional to the focal length; it was computed with the camera's own.
    """
    residuals = np.empty((len(images), 3))
    computed_px = camera.distort(normalised)
    fill_in_residuals(
        points, pose.focal_scale, computed_px, images.pixels, images.distances_m, residuals
    )
    return residuals


def _covariances(images: PointImages, by_point: FloatArray) -> FloatArray:
    """Return the covariances (n, 3, 3) of the observations, including those of the positions."""
    cov = np.empty_like(by_point)
    sds = images.sd_distances_m
    fill_in_covariances(
        by_point, images.position_cov, images.pixel_cov, images.distances_m, sds, cov
    )
    return cov


def _chi2(residuals: FloatArray, cov: FloatArray) -> FloatArray:
    """Return the χ² (n,) of points; infinite behind the camera."""
    squares = np.empty(len(residuals))
    if not fill_in_squares(residuals, cov, squares):
        raise np.linalg.LinAlgError("a covariance is singular")
    return squares


def adjusted_pose(
    camera: Camera, images: PointImages, start: CameraPose, sd_focal: float
) -> tuple[CameraPose, FloatArray, FloatArray] | None:
    """Return pose, covariance and residuals (n, 3) of an adjustment to all points.

    Parameters
    ----------
    start : CameraPose
        Approximate pose; all points must lie in front of the camera.
    sd_focal : float
        As for `orient`.

    Returns
    -------
    tuple or None
        None if a point falls behind the camera, or the pose is not determined.
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
    """Return the χ² (n,) of points; infinite behind the camera.

    Parameters
    ----------
    slack_px : float
        Additional standard deviation of the places.
    """
    ahead = _is_ahead(images, pose)
    chi2 = np.full(len(images), np.inf)
    if ahead.any():
        kept = images.chosen(ahead)
        near = _linearised(camera, kept, pose)
        cov = _covariances(kept, near.by_point)
        cov[:, :2, :2] += slack_px**2 * np.eye(2)
        chi2[ahead] = _chi2(near.residuals - near.common @ _estimated_common(kept, near, cov), cov)
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
    max_steps: int = MAX_STEPS,
    within: FloatArray | None = None,
) -> CameraPose | None:
    """Return the pose with the least weighted squares; None if a point falls behind the camera.

    Parameters
    ----------
    within : (6, k) or (7, k) array, optional
        Directions to which steps are limited; by default all are allowed.
    """
    is_weighted = weights > 1e-9
    kept, weight = images.chosen(is_weighted), weights[is_weighted]
    if np.count_nonzero(is_weighted) < 3:
        return None
    pose, damping = start, 1e-6
    normal, right, cost = _normal_equations(camera, kept, pose, weight, sd_focal)
    if not math.isfinite(cost):
        return None
    basis = np.eye(len(normal)) if within is None else within
    for _ in range(max_steps):
        scaled = basis / np.sqrt(np.maximum(np.diag(basis.T @ normal @ basis), 1e-300))
        unit = scaled.T @ normal @ scaled
        while True:
            damped = unit + damping * np.eye(len(unit))
            step = scaled @ np.linalg.solve(damped, scaled.T @ right)
            if float(step @ right) <= _ROUNDING:
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
    """Return normal matrix, right-hand side and weighted squares of the pose.

    The focal length is among the unknowns if it has a standard deviation.
    """
    unknowns = 7 if sd_focal else 6
    if not _is_ahead(images, pose).all():
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    near = _linearised(camera, images, pose)
    cov = _covariances(images, near.by_point)
    square = np.zeros((unknowns + 1 + near.common.shape[2],) * 2)
    observed = near.design, near.residuals, near.common
    if not add_products(unknowns, *observed, cov, weights, square):
        # the step put a point into the projection centre
        return np.eye(unknowns), np.zeros(unknowns), math.inf
    square = _without_common(square, near.precisions)
    normal, right = square[:unknowns, :unknowns], square[:unknowns, unknowns]
    cost = float(square[unknowns, unknowns])
    if sd_focal:
        log_scale = math.log(pose.focal_scale)
        normal[6, 6] += 1.0 / sd_focal**2
        right[6] -= log_scale / sd_focal**2
        cost += (log_scale / sd_focal) ** 2
    return normal, right, cost


def _without_common(square: FloatArray, precisions: FloatArray) -> FloatArray:
    """Eliminate the last k unknowns from a matrix of products of columns (Schur complement)."""
    if not len(precisions):
        return square
    kept = len(square) - len(precisions)
    normal = square[kept:, kept:] + np.diag(precisions)
    return np.asarray(
        square[:kept, :kept] - square[:kept, kept:] @ np.linalg.solve(normal, square[kept:, :kept])
    )


def position_equations(
    camera: Camera,
    images: PointImages,
    pose: CameraPose,
    sd_focal: float,
    by_calibration: FloatArray,
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return normal equations of corrections to positions and calibration, without the pose.

    Parameters
    ----------
    images : PointImages
        Their `position_cov` is ignored.
    pose : CameraPose
        Approximate pose.
    sd_focal : float
        As for `orient`.
    by_calibration : (n, 3, k) array
        Derivatives of computed minus observed places and logarithms of distances.

    Returns
    -------
    normal : (3 n + k, 3 n + k) array
        Singular, because all points together can be shifted and rotated.
    right : (3 n + k,) array
    squares : float
        Weighted squares of the residuals without corrections.
        None instead of all three if a point is behind the camera, or the pose is not determined.
    """
    if not _is_ahead(images, pose).all():
        return None
    near = _linearised(camera, images, pose)
    exact = replace(images, position_cov=np.zeros_like(images.position_cov))
    unknowns = 7 if sd_focal else 6
    measured = np.nan_to_num(near.residuals)[..., None]
    corrected = _by_positions(near), by_calibration, measured
    rows = np.concatenate((*corrected, near.design[:, :, :unknowns], near.common), axis=2)
    square = np.einsum(
        "nmp,nmq->pq", rows, np.linalg.solve(_covariances(exact, near.by_point), rows)
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
    """Return the derivatives of an adjusted pose by its points' positions.

    Returns
    -------
    (6, n, 3) or (7, n, 3) array
        Derivatives of the pose's step.
    """
    near = _linearised(camera, images, pose)
    slopes = _pose_slopes(images, near, _by_positions(near), sd_focal)
    return slopes.reshape(len(slopes), len(images), 3)


def observations_by_calibration(
    camera: Camera, sightings: Sequence[Sighting], count: int
) -> FloatArray:
    """Return the derivatives (n, 3, count) of computed minus measured places and logs of distances.

    They are those by the first of `CALIBRATION_PARAMETERS`.
    """
    pixels = np.array([each.centre_px for each in sightings])
    slopes = np.zeros((len(sightings), 3, count))
    slopes[:, :2] = distort_jacobian_by_calibration(camera, camera.undistort(pixels))[..., :count]
    for row, each in enumerate(sightings):
        if each.pose is not None:
            radius_m = _RING_SHARE * each.pose.distance_m
            by_pose = pose_by_calibration(camera, radius_m, each.pose)[:3, :count]
            slopes[row, 2] = -each.pose.translation_m @ by_pose / each.pose.distance_m**2
    return slopes


def calibration_slopes(
    camera: Camera, images: PointImages, pose: CameraPose, by_calibration: FloatArray
) -> FloatArray:
    """Return the derivatives (6, k) of an adjusted pose, for `by_calibration` as above."""
    return _pose_slopes(images, _linearised(camera, images, pose), by_calibration, 0.0)


def _pose_slopes(
    images: PointImages, near: _Linearised, by_cause: FloatArray, sd_focal: float
) -> FloatArray:
    """Return the derivatives of an adjusted pose by what changes observations by `by_cause`."""
    unknowns = 7 if sd_focal else 6
    rows = np.concatenate((near.design[:, :, :unknowns], -by_cause, near.common), axis=2)
    weighted = np.linalg.solve(_covariances(images, near.by_point), rows)
    reduced = _without_common(np.einsum("nmp,nmq->pq", rows, weighted), near.precisions)
    normal = reduced[:unknowns, :unknowns]
    if sd_focal:
        normal[6, 6] += 1.0 / sd_focal**2
    return np.asarray(np.linalg.solve(normal, reduced[:unknowns, unknowns:]))


def scale_at(camera: Camera, images: PointImages, pose: CameraPose) -> float:
    """Return the logarithm of the factor by which all distances are too long; 0: not estimated."""
    return float(common_errors(camera, images, pose)[0][0]) if images.sd_scale else 0.0


def common_errors(
    camera: Camera, images: PointImages, pose: CameraPose
) -> tuple[FloatArray, float]:
    """Return the common errors (k,) of all points, and their χ² by a-priori variances.

    They are the logarithm of the distances' scale, if it is unknown, and the camera's motion during
    the readout, if it is unknown.
    """
    near = _linearised(camera, images, pose)
    amounts = _estimated_common(images, near, _covariances(images, near.by_point))
    return amounts, float(near.precisions @ amounts**2)


def _estimated_common(images: PointImages, near: _Linearised, cov: FloatArray) -> FloatArray:
    """Return the common errors (k,) of all points from their residuals.

    The estimate is robust: points with wrong names hardly count.
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
        weights = 1.0 / (1.0 + chi2 / _HALF_WEIGHT_CHI2)
        normal = np.einsum("n,npq->pq", weights, products)
        amounts = np.linalg.solve(normal[:, :-1] + np.diag(near.precisions), normal[:, -1])
    return np.asarray(amounts)


def _scale(images: PointImages, residuals: FloatArray, cov: FloatArray) -> float:
    """Return the logarithm of the factor by which all distances are too long.

    Residuals (n, 3) far from the median have little weight, so that wrong names hardly count.
    """
    is_measured = images.has_distance & np.isfinite(residuals).all(axis=1)
    if not is_measured.any():
        return 0.0
    logs, variances = residuals[is_measured, 2], cov[is_measured, 2, 2]
    chi2 = (logs - np.median(logs)) ** 2 / variances
    weights = 1.0 / (variances * (1.0 + chi2 / _HALF_WEIGHT_CHI2))
    return float(weights @ logs / (weights.sum() + images.sd_scale**-2.0))


def covariance_and_residuals(
    camera: Camera, images: PointImages, pose: CameraPose, used: BoolArray, sd_focal: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return covariance, residuals and χ² of a pose; None if it is not determined.

    Residuals are corrected for the motion during the readout, but not for the distances' scale.
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
        amounts, _ = common_errors(camera, kept, pose)
        residuals = near.residuals - near.common[:, :, -6:] @ amounts[-6:]
    return 0.5 * (cov + cov.T), residuals, chi2


def second_order_cov(
    camera: Camera, images: PointImages, pose: CameraPose, cov: FloatArray, sd_focal: float
) -> FloatArray | None:
    """Return the second-order part of the covariance, if one rotation is hardly determined.

    Likely poses then lie along a curve. At t standard deviations of this rotation, the step from
    the estimated pose is t d + t² q to second order. If t is normally distributed, the mean square
    of the second term is 3 q qᵀ. q is found by following the curve to ± 3 standard deviations.

    Returns
    -------
    array or None
        None if there is no pose at an end of the curve, or if that pose fits too well. This
        happens where the two poses of a plane seen frontally merge.
    """
    variances, axes = np.linalg.eigh(cov[3:6, 3:6])
    along = np.zeros(len(cov))
    along[3:6] = axes[:, -1]
    to_end = _CURVE_END_SD * cov @ along / math.sqrt(variances[-1])
    across = null_space(along[None])
    weights = np.ones(len(images))
    _, _, least = _normal_equations(camera, images, pose, weights, sd_focal)
    curvature = np.zeros(len(cov))
    for step in (to_end, -to_end):
        end = minimised(camera, images, pose.moved(step), weights, sd_focal, within=across)
        if end is None:
            return None
        _, _, cost = _normal_equations(camera, images, end, weights, sd_focal)
        if cost - least < _MIN_RISE * _CURVE_END_SD**2:
            return None
        curvature += 0.5 * _step_between(pose, end, len(cov)) / _CURVE_END_SD**2
    return 3.0 * np.outer(curvature, curvature)


def _step_between(pose: CameraPose, other: CameraPose, unknowns: int) -> FloatArray:
    """Return the step from one pose to another: shift, left rotation vector, focal length."""
    vector = Rotation.from_matrix(other.world_from_camera @ pose.world_from_camera.T).as_rotvec()
    focal = math.log(other.focal_scale / pose.focal_scale)
    return np.array([*(other.centre_m - pose.centre_m), *vector, focal])[:unknowns]
