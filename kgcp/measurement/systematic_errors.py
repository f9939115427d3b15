"""Errors that all frames share: the camera's calibration and the size of the print.

Averaging over frames does not reduce them. So they are not part of a measurement's own covariance,
and are reported separately.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.calibration import CalibrationCovariance, distort_jacobian_by_calibration
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import CommonUncertainty
from kgcp.targets.layout import Ring
from kgcp.targets.plain import AnyTarget

_POINTS = 24
_ALONG_EDGE = 0.05  # weight of residuals along the circle's edge, against 1 across it


def common_uncertainty(
    camera: Camera, calibration: CalibrationCovariance | None, ring: Ring | AnyTarget, pose: Pose
) -> CommonUncertainty | None:
    """Propagate calibration and diameter to a measured pose, to first order.

    The image is given. If the calibration changes, the pose moves so that the ring's outer circle
    still fits it by least squares. An error of the diameter is one of all lengths of the print, and
    moves the target along its ray.

    Parameters
    ----------
    calibration : CalibrationCovariance or None
        None if it is unknown.
    ring : Ring, Target or PlainTarget
        The target, or its main ring.
    pose : Pose
        As measured.

    Returns
    -------
    CommonUncertainty or None
        None if neither calibration nor diameter has a standard deviation.
    """
    if calibration is None and ring.sd_outer_diameter_m == 0.0:
        return None
    by_size = np.concatenate((pose.translation_m / ring.outer_diameter_m, np.zeros(3)))
    pose_cov = ring.sd_outer_diameter_m**2 * np.outer(by_size, by_size)
    if calibration is not None:
        by_calibration = pose_by_calibration(camera, 0.5 * ring.outer_diameter_m, pose)
        pose_cov += by_calibration @ calibration.cov @ by_calibration.T
    along = pose.translation_m / pose.distance_m
    square = np.eye(3) - np.outer(along, along)
    across_cov = square @ pose_cov[:3, :3] @ square
    widest = float(np.linalg.eigvalsh(across_cov)[-1])
    return CommonUncertainty(
        pose_cov=pose_cov,
        sd_distance_m=math.sqrt(max(0.0, float(along @ pose_cov[:3, :3] @ along))),
        sd_direction_mrad=1e3 * math.sqrt(max(0.0, widest)) / pose.distance_m,
    )


def pose_by_calibration(camera: Camera, radius_m: float, pose: Pose) -> FloatArray:
    """Return the derivatives of a pose by the calibration, for a given image of the ring's circle.

    Returns
    -------
    (6, 12) array
        Rows as in `Uncertainty.pose_cov`, columns `CALIBRATION_PARAMETERS`.
    """
    angles = 2.0 * np.pi / _POINTS * np.arange(_POINTS)
    cosine, sine = radius_m * np.cos(angles), radius_m * np.sin(angles)
    points = pose.transform(np.stack((cosine, sine), axis=-1))
    normalised = points[:, :2] / points[:, 2:]
    by_point = camera.distort_jacobian(normalised) @ _by_point(points)
    by_turn = -cross_matrix(points - pose.translation_m)
    by_pose = np.concatenate((by_point, by_point @ by_turn), axis=2)
    along_circle = np.stack((-sine, cosine), axis=-1) @ pose.rotation[:, :2].T
    weigh = _edge_weights((by_point @ along_circle[:, :, None])[:, :, 0])
    by_calibration = weigh @ distort_jacobian_by_calibration(camera, normalised)
    # Metres and radians: the first three columns are scaled to be comparable with the others.
    scale = np.array([*(pose.distance_m,) * 3, 1.0, 1.0, 1.0])
    design = (weigh @ by_pose).reshape(-1, 6) * scale
    moved = np.linalg.lstsq(design, by_calibration.reshape(2 * _POINTS, -1), rcond=None)[0]
    follows: FloatArray = -scale[:, None] * moved
    return follows


def _edge_weights(along: FloatArray) -> FloatArray:
    """Return the matrices (n, 2, 2) that make weighted residuals of displacements of an edge [px].

    An edge shows how far it is displaced across its direction `along` (n, 2). The dots give a
    little information along it, too, which determines the heading and hardly counts otherwise.
    """
    x, y = (along / np.linalg.norm(along, axis=1, keepdims=True)).T
    rows = np.stack((-y, x), -1), _ALONG_EDGE * np.stack((x, y), -1)
    return np.stack(rows, 1)


def _by_point(points: FloatArray) -> FloatArray:
    """Return the derivatives (n, 2, 3) of normalised coordinates by points (n, 3)."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    return np.stack(
        (np.stack((1.0 / z, zero, -x / z**2), -1), np.stack((zero, 1.0 / z, -y / z**2), -1)), 1
    )
