"""The pose of concentric circles from centroids and second moments of their images.

The sizes of the circles are known, and the normal of their plane approximately. Moments of circles
are projected through the lens (`geometry.circle_image`). So neither eccentricity nor distortion
within the target displaces the result: it is the circles' centre. The prior of the normal is an
observation like the others, so that its uncertainty is in the covariance of the centre. The effect
of a rolling shutter is, too, as far as the motion is not known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes
from kgcp.geometry.circle_image import Circles3D, circle_derivatives
from kgcp.geometry.conic import Ellipse, fit_ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.image_model.rolling_shutter import motion_per_row
from kgcp.measurement.plate_prior import NormalPrior, SceneRotation

_STEPS = 12
_SETTLED = 1e-9  # largest last step, relative to the distance and in radians
_LARGEST_TURN_RAD = 0.3  # in one step
_TURN = np.linspace(0.0, 2.0 * math.pi, 32, endpoint=False)
_LEAST_TILT_RAD = 0.05  # of a start; at 0 the image has no gradient by the tilt
_ANY_HEADING_RAD2 = math.pi**2 / 3.0  # variance of an unknown angle


@dataclass(frozen=True, slots=True, eq=False)
class CircleMoments:
    """Images of k concentric circles.

    Attributes
    ----------
    radii_m : (k,) array
        Of the circles [m].
    moments : (k, 5) array
        Centroids and second moments, as `discs.records.MOMENTS`.
    covs : (k, 5, 5) array
        Covariance of each circle's moments.
    """

    radii_m: FloatArray
    moments: FloatArray
    covs: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CirclesFit:
    """A pose fitted to images of circles.

    Attributes
    ----------
    pose : Pose
        Its x axis is as near to the camera's as the plane allows: circles have no heading.
    pose_cov : (6, 6) array
        As in `Uncertainty`; about the normal, the variance of an unknown angle.
    chi2 : float
        Sum over all images and the prior of the normal.
    """

    pose: Pose
    pose_cov: FloatArray
    chi2: float


def pose_towards(centre_m: FloatArray, normal: FloatArray) -> Pose:
    """Return the pose of circles with a centre and a unit normal, both in the camera frame."""
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    if np.linalg.norm(x) < 1e-6:  # seen from the side: any axis will do
        x = np.cross(normal, [0.0, 1.0, 0.0])
    x = x / np.linalg.norm(x)
    return Pose(np.column_stack((x, np.cross(normal, x), normal)), np.asarray(centre_m))


def pose_of_ellipse(camera: Camera, ellipse: Ellipse, radius_m: float) -> Pose:
    """Return one of the two poses of a circle whose image is a given ellipse [raw px].

    It is tilted by at least 0.05 rad: seen frontally, a circle leaves an adjustment no gradient.

    Raises
    ------
    Rejection
        If no circle in front of the camera has this image.
    """
    outline = camera.undistort(ellipse.points(_TURN))
    plane = circle_planes(fit_ellipse(outline))[0]
    pose = pose_towards(radius_m * plane.centre, plane.normal).tilted(_LEAST_TILT_RAD)
    return pose_towards(pose.translation_m, pose.normal)


def circles_about(pose: Pose, radii_m: FloatArray) -> Circles3D:
    """Return concentric circles around the origin of a pose."""
    count = len(radii_m)
    return Circles3D(
        np.repeat(pose.translation_m[None], count, axis=0),
        np.repeat(pose.rotation[None, :, :2], count, axis=0),
        np.asarray(radii_m, dtype=np.float64),
    )


def fit_circles(
    camera: Camera,
    images: CircleMoments,
    start: Pose,
    prior: NormalPrior,
    rotation: SceneRotation | None = None,
) -> CirclesFit:
    """Adjust a pose to the images of concentric circles, by Gauss-Newton steps.

    `rotation` is that of the scene during the readout; None: `SceneRotation.unknown`.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the circles get behind the camera, or the equations are singular.
    """
    images, cov_together = at_one_moment(camera, images, rotation)
    root: FloatArray = np.linalg.cholesky(cov_together).astype(np.float64)
    pose = start
    for _ in range(_STEPS):
        residuals, design, axes = _equations(camera, images, root, pose, prior)
        scale = np.array([*(pose.distance_m,) * 3, 1.0, 1.0])
        normal = (design * scale).T @ (design * scale)
        step = scale * np.linalg.solve(normal, (design * scale).T @ residuals)
        turn = axes @ step[3:]
        turn *= min(1.0, _LARGEST_TURN_RAD / max(float(np.linalg.norm(turn)), 1e-12))
        moved = pose.moved(np.concatenate((step[:3], turn)))
        pose = pose_towards(moved.translation_m, moved.normal)
        if np.abs(step / scale).max() < _SETTLED:
            break
    residuals, design, axes = _equations(camera, images, root, pose, prior)
    to_six = np.zeros((6, 5))
    to_six[:3, :3], to_six[3:, 3:] = np.eye(3), axes
    cov = to_six @ np.linalg.inv(design.T @ design) @ to_six.T
    cov[3:, 3:] += _ANY_HEADING_RAD2 * np.outer(pose.normal, pose.normal)
    return CirclesFit(pose, 0.5 * (cov + cov.T), float(residuals @ residuals))


def _equations(
    camera: Camera, images: CircleMoments, root: FloatArray, pose: Pose, prior: NormalPrior
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weighted residuals (5k + 2,), design matrix (5k + 2, 5) and axes of the two tilts."""
    circles = circles_about(pose, images.radii_m)
    slopes = circle_derivatives(camera, circles)
    axes = pose.rotation[:, :2]
    off = images.moments - slopes.moments
    if not np.isfinite(off).all():
        raise np.linalg.LinAlgError("circles are not wholly before the camera")
    by_pose = np.concatenate((slopes.by_centre, slopes.by_rotation @ axes), axis=2)
    residuals = np.linalg.solve(root, off.ravel())
    design = np.linalg.solve(root, by_pose.reshape(-1, 5))
    turn = axes.T @ _turn_to(pose.normal, prior.direction_camera)
    weight = 1.0 / math.radians(prior.sd_deg)
    of_prior = np.hstack((np.zeros((2, 3)), weight * np.eye(2)))
    return np.concatenate((residuals, weight * turn)), np.vstack((design, of_prior)), axes


def at_one_moment(
    camera: Camera, images: CircleMoments, rotation: SceneRotation | None
) -> tuple[CircleMoments, FloatArray]:
    """Return images as if all rows had been exposed at once, and their covariance (5k, 5k).

    While rows are exposed one after the other, the image moves by v per row. That shears it to
    x + vₓ (y − y₀), y + v_y (y − y₀), and changes its second moments. All circles have the same v.
    Its known part is taken off the moments; the unknown part is in the covariance.
    """
    count = len(images.moments)
    by_circle = np.zeros((count, 5, count, 5))
    by_circle[range(count), :, range(count)] = images.covs
    cov = by_circle.reshape(5 * count, 5 * count)
    if not camera.readout_s:
        return images, cov
    rotation = rotation or SceneRotation.unknown(camera)
    by_motion = np.zeros((count, 5, 2))
    _, _, _, xy, yy = images.moments.T
    by_motion[:, 2, 0], by_motion[:, 3, 0] = 2.0 * xy, yy
    by_motion[:, 3, 1], by_motion[:, 4, 1] = xy, 2.0 * yy
    by_rotation = by_motion.reshape(-1, 2) @ motion_per_row(camera, images.moments[0, :2])
    moved = (by_rotation @ np.array(rotation.velocity_rad_s)).reshape(count, 5)
    cov = cov + rotation.sd_rad_s**2 * by_rotation @ by_rotation.T
    covs = np.array([cov[5 * k : 5 * k + 5, 5 * k : 5 * k + 5] for k in range(count)])
    return CircleMoments(images.radii_m, images.moments - moved, covs), cov


def _turn_to(direction: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) that turns one unit vector to another [rad]."""
    axis = np.cross(direction, wanted)
    sine, cosine = float(np.linalg.norm(axis)), float(direction @ wanted)
    return np.asarray(axis * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0))
