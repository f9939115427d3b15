"""Reference poses of the camera in the flight's ENU frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import (
    CAMERA_FROM_PHOTO,
    ReferencePoses,
    covariance_along,
    rotation_from_opk,
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
    # (n, 3, 3): covariances of the centres in ENU axes [m²]; None: the poses have no standard
    # deviations
    cov_m2: FloatArray | None

    @classmethod
    def of(cls, poses: ReferencePoses, local_frame: LocalFrame) -> Self:
        """Transform reference poses from the map into the ENU frame."""
        centre = local_frame.enu_from_map(poses.position_map)
        enu_from_map = local_frame.grid_rotation(centre)
        sd = poses.sd_position_m
        cov = None if sd is None else covariance_along(enu_from_map, sd)
        # CAMERA_FROM_PHOTO = diag(1, -1, -1) is its own inverse
        enu_from_camera = enu_from_map @ rotation_from_opk(poses.opk_deg) @ CAMERA_FROM_PHOTO
        return cls(centre, enu_from_camera, cov)


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
