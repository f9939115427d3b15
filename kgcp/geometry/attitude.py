"""Attitudes and their covariances, and the camera's reference poses from a bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray

CAMERA_FROM_PHOTO: FloatArray = np.diag([1.0, -1.0, -1.0])
"""From camera axes of photogrammetry (x right, y up, z backward) to kgcp's (right, down,
forward)."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePoses:
    """Exterior orientations of n frames."""

    # unique names as in the detections: relative to the frames folder, with / as separator
    frames: tuple[str, ...]
    position_map: FloatArray  # (n, 3): projection centres x, y, z in the flight's CRS
    opk_deg: FloatArray  # (n, 3): omega, phi, kappa relative to the map's axes [deg]
    # (n, 3): standard deviations along the map's axes [m]; None if not given
    sd_position_m: FloatArray | None
    # (n,): standard deviation of each of the three angles [deg]; None if not given
    sd_angle_deg: FloatArray | None
    # (n, 6, 6): covariances of position [m] and left rotation vector [rad], the map's axes; None if
    # not given: errors of positions and angles count as uncorrelated
    cov: FloatArray | None = None


def rotation_from_opk(opk_deg: FloatArray) -> FloatArray:
    """Return rotations (n, 3, 3) camera → map from omega, phi, kappa (n, 3) [deg].

    R = Rx(ω) Ry(φ) Rz(κ), for camera axes x right, y up, z backward (docs/conventions.md).
    """
    from scipy.spatial.transform import Rotation  # here, since workers need not load it: 0.2 s

    return np.asarray(Rotation.from_euler("XYZ", opk_deg, degrees=True).as_matrix())


def opk_from_rotation(map_from_photo: FloatArray) -> FloatArray:
    """Return omega, phi, kappa (n, 3) [deg] of rotations (n, 3, 3): inverts `rotation_from_opk`."""
    from scipy.spatial.transform import Rotation  # as above

    return np.asarray(Rotation.from_matrix(map_from_photo).as_euler("XYZ", degrees=True))


def rotation_onto(points: FloatArray, others: FloatArray) -> FloatArray:
    """Return the rotation R (3, 3) that brings `points @ R.T` closest to `others`, both (n, 3).

    Least squares about both means, without reflections (Kabsch, Acta Crystallographica A32, 1976).
    If the points are collinear, the rotation is not unique and one of them is returned.
    """
    before, after = points - points.mean(axis=0), others - others.mean(axis=0)
    left, _, right = np.linalg.svd(after.T @ before)
    proper = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))])
    return np.asarray(left @ proper @ right)


def turned_covariance(axes: FloatArray, cov: FloatArray) -> FloatArray:
    """Return covariances (n, 6, 6) of pairs of vectors in other axes: A v for axes A (n, 3, 3)."""
    both = np.zeros((len(axes), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = axes
    return np.asarray(both @ cov @ np.swapaxes(both, 1, 2))


def place_covariances(pose_cov: FloatArray, sight: FloatArray) -> FloatArray:
    """Return the covariances (..., 3, 3) that poses give to places in sight.

    With R' = exp(ω) R and C' = C + δ, a place C + s moves by δ + ω × s.

    Parameters
    ----------
    pose_cov : (..., 6, 6) array
        Of projection centre and left rotation vector [rad].
    sight : (..., 3) array
        From the projection centres to the places, in the same axes and unit.
    """
    identity = np.broadcast_to(np.eye(3), (*sight.shape, 3))
    by_error = np.concatenate((identity, -cross_matrix(sight)), axis=-1)
    return np.asarray(by_error @ pose_cov @ np.swapaxes(by_error, -1, -2))


def down_in_camera(opk_deg: FloatArray) -> FloatArray:
    """Return the downward vertical (n, 3) in the camera frame, from omega, phi, kappa (n, 3).

    The third axis of every map frame is the local vertical. So meridian convergence and CRS do not
    matter.
    """
    photo_from_map = np.swapaxes(rotation_from_opk(opk_deg), 1, 2)
    return np.asarray(-photo_from_map[:, :, 2] @ CAMERA_FROM_PHOTO.T)


def attitude_axes(frame_from_body: FloatArray, down: FloatArray) -> FloatArray:
    """Return the axes (n, 3, 3) of roll, pitch and heading of a body, as columns.

    Roll turns about the body's x axis and heading about the vertical `down` (n, 3). Pitch turns
    about the horizontal axis perpendicular to both.
    """
    forward = frame_from_body[:, :, 0]
    right = np.cross(down, forward)
    right = right / np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack((forward, right, down), axis=-1)


def covariance_along(axes: FloatArray, sd: FloatArray) -> FloatArray:
    """Return A diag(σ²) Aᵀ (..., m, m) for axes A (..., m, n) as columns and σ (..., n)."""
    scaled = axes * sd[..., None, :]
    return np.asarray(scaled @ np.swapaxes(scaled, -1, -2))


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the skew-symmetric matrices [v]× (..., 3, 3) of vectors v (..., 3): [v]× w = v × w."""
    matrices = np.zeros((*vectors.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[..., j, k], matrices[..., k, j] = -vectors[..., i], vectors[..., i]
    return matrices
