"""Points of known position in one frame, and the frame's exterior orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.pose import rotation_about


@dataclass(frozen=True, slots=True, eq=False)
class PointImages:
    """n points of known position in one frame."""

    positions_m: FloatArray  # (n, 3): in a Cartesian frame, called the world
    position_cov: FloatArray  # (n, 3, 3): zeros: exact
    pixels: FloatArray  # (n, 2): images of the points, raw pixels
    pixel_cov: FloatArray  # (n, 2, 2)
    distances_m: FloatArray  # (n,): camera to point, as the image's size says; NaN: not known
    sd_distances_m: FloatArray  # (n,)
    # of the logarithm of what all distances are off by alike: prints, focal length; 0: nothing
    sd_scale: float = 0.0

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, which: BoolArray) -> PointImages:
        """Return some of the points."""
        return PointImages(
            self.positions_m[which],
            self.position_cov[which],
            self.pixels[which],
            self.pixel_cov[which],
            self.distances_m[which],
            self.sd_distances_m[which],
            self.sd_scale,
        )

    @property
    def has_distance(self) -> BoolArray:
        """Whether the distance of each point is known (n,)."""
        return np.asarray(np.isfinite(self.distances_m))


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """Exterior orientation of one frame."""

    centre_m: FloatArray  # (3,): projection centre in the world
    world_from_camera: FloatArray  # (3, 3): camera axes in the world, as columns
    focal_scale: float = 1.0  # of the camera's principal distances

    def moved(self, step: FloatArray) -> CameraPose:
        """Return the pose after a step: shift [m], left rotation [rad], relative focal length."""
        turn = rotation_about(np.ascontiguousarray(step[3:6]))
        scale = self.focal_scale * math.exp(step[6]) if len(step) > 6 else self.focal_scale
        return CameraPose(self.centre_m + step[:3], turn @ self.world_from_camera, scale)

    def in_camera(self, points_m: FloatArray) -> FloatArray:
        """Bring points (n, 3) of the world into the camera frame."""
        return (points_m - self.centre_m) @ self.world_from_camera
