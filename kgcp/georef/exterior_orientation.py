"""Reference poses of the camera in the flight's ENU frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import (
    CAMERA_FROM_PHOTO,
    ReferencePoses,
    covariance_along,
    place_covariances,
    rotation_from_opk,
    turned_covariance,
)
from kgcp.geometry.camera import Camera
from kgcp.georef.local_frame import LocalFrame

# Largest difference, in normalised coordinates, of a point that is distorted and undistorted.
_FOLD_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ExteriorOrientations:
    """Exterior orientations of n frames."""

    centre_m: FloatArray  # (n, 3): projection centres in the ENU frame [m]
    # (n, 3, 3): camera axes (x right, y down, z forward) in the ENU frame, as columns
    enu_from_camera: FloatArray
    # (n, 6, 6): covariances of the centres [m] and of left rotation vectors [rad], ENU axes; what
    # the poses do not state counts as exact; None: they state nothing
    cov: FloatArray | None
    states_centres: bool  # whether `cov` has the accuracy of the centres
    states_angles: bool  # and that of the attitudes

    @classmethod
    def of(cls, poses: ReferencePoses, local_frame: LocalFrame) -> Self:
        """Transform reference poses from the map into the ENU frame."""
        centre = local_frame.enu_from_map(poses.position_map)
        enu_from_map = local_frame.grid_rotation(centre)
        # CAMERA_FROM_PHOTO = diag(1, -1, -1) is its own inverse
        enu_from_camera = enu_from_map @ rotation_from_opk(poses.opk_deg) @ CAMERA_FROM_PHOTO
        return cls(
            centre,
            enu_from_camera,
            cov=_stated_covariance(poses, enu_from_map),
            states_centres=poses.cov is not None or poses.sd_position_m is not None,
            states_angles=poses.cov is not None or poses.sd_angle_deg is not None,
        )

    @property
    def cov_m2(self) -> FloatArray | None:
        """Covariances (n, 3, 3) of the centres in ENU axes [m²]; None: not stated."""
        return None if self.cov is None or not self.states_centres else self.cov[:, :3, :3]

    @property
    def states_all(self) -> bool:
        """Whether `cov` has the accuracy of centres and attitudes."""
        return self.states_centres and self.states_angles

    @property
    def has_correlations(self) -> bool:
        """Whether `cov` has the covariances of position and rotation, as poses by points have."""
        return self.cov is not None and bool(self.cov[:, :3, 3:].any())

    def place_covariances(self, rows: Sequence[int], sight_m: FloatArray) -> FloatArray:
        """Return the covariances (n, 3, 3) that the orientations give to places in sight [m²].

        Parameters
        ----------
        rows : sequence of int
            Which orientations.
        sight_m : (n, 3) array
            From the projection centres to the places, ENU axes.
        """
        if self.cov is None:
            return np.zeros((len(sight_m), 3, 3))
        return place_covariances(self.cov[[*rows]], sight_m)


def _stated_covariance(poses: ReferencePoses, enu_from_map: FloatArray) -> FloatArray | None:
    if poses.cov is not None:
        return turned_covariance(enu_from_map, poses.cov)
    if poses.sd_position_m is None and poses.sd_angle_deg is None:
        return None
    cov = np.zeros((len(enu_from_map), 6, 6))
    if poses.sd_position_m is not None:
        cov[:, :3, :3] = covariance_along(enu_from_map, poses.sd_position_m)
    if poses.sd_angle_deg is not None:
        cov[:, 3:, 3:] = np.radians(poses.sd_angle_deg)[:, None, None] ** 2 * np.eye(3)
    return cov


def visible_pixel(camera: Camera, point_camera: FloatArray) -> FloatArray:
    """Project one point (3,) in the camera frame to a raw pixel (2,), as `visible_pixels`."""
    (pixel,) = visible_pixels(camera, point_camera[None])
    return np.asarray(pixel)


def visible_pixels(camera: Camera, points_camera: FloatArray) -> FloatArray:
    """Project points (n, 3) in the camera frame to raw pixels (n, 2).

    NaN for points behind the camera, and for those beyond the radius at which its distortion stops
    growing: there, two rays share one pixel.
    """
    pixels = np.full((len(points_camera), 2), np.nan)
    ahead = points_camera[:, 2] > 0.0
    normalised = points_camera[ahead, :2] / points_camera[ahead, 2:]
    distorted = camera.distort(normalised)
    error = np.linalg.norm(camera.undistort(distorted) - normalised, axis=1)
    distorted[~(error < _FOLD_TOLERANCE)] = np.nan
    pixels[ahead] = distorted
    return pixels
