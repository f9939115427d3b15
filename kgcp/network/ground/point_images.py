"""Points of known position in one frame, and the frame's exterior orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.measurement.plate_prior import SceneRotation


@dataclass(frozen=True, slots=True, eq=False)
class Readout:
    """Exposure times of n points by a rolling shutter, and the camera's motion meanwhile."""

    delay_s: FloatArray  # (n,): after the middle row, to whose moment the pose refers
    rotation: SceneRotation  # of the scene, by the camera's rotation alone
    # standard deviation of the apparent rotation of the scene, about each axis, by the camera's
    # shift, which its rates do not show
    sd_shift_rad_s: float

    @classmethod
    def of(
        cls, camera: Camera, pixels: FloatArray, rotation: SceneRotation | None = None
    ) -> Readout | None:
        """Return the readout of points at raw pixels (n, 2); None: all are exposed at once.

        Parameters
        ----------
        rotation : SceneRotation, optional
            The scene's rotation by the camera's rates; by default that of the camera's settings.
        """
        if not camera.readout_s:
            return None
        unknown = SceneRotation.unknown(camera)
        return cls(camera.delay_s(pixels), rotation or unknown, unknown.sd_rad_s)

    def chosen(self, which: BoolArray) -> Readout:
        """Return the readout of some of the points."""
        return replace(self, delay_s=self.delay_s[which])


@dataclass(frozen=True, slots=True, eq=False)
class PointImages:
    """n points of known position in one frame."""

    positions_m: FloatArray  # (n, 3): in a Cartesian frame, called the world
    position_cov: FloatArray  # (n, 3, 3); zeros: exact
    pixels: FloatArray  # (n, 2): images of the points, raw pixels
    pixel_cov: FloatArray  # (n, 2, 2)
    distances_m: FloatArray  # (n,): camera to point, from the size of its image; NaN: unknown
    sd_distances_m: FloatArray  # (n,)
    # standard deviation of the logarithm of the distances' common scale, by prints and focal
    # length; 0: the scale is exact
    sd_scale: float = 0.0
    readout: Readout | None = None  # None: all points are exposed at the moment of the pose

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
            None if self.readout is None else self.readout.chosen(which),
        )

    @property
    def motion_sd_rad(self) -> FloatArray:
        """Typical rotation (n,) of each point since the moment of the pose [rad]."""
        if self.readout is None:
            return np.zeros(len(self))
        velocity = np.array(self.readout.rotation.velocity_rad_s)
        sds = self.readout.rotation.sd_rad_s, self.readout.sd_shift_rad_s
        speed = math.hypot(float(np.linalg.norm(velocity)), max(sds))
        return np.asarray(speed * np.abs(self.readout.delay_s))

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
        """Transform points (n, 3) from the world to the camera frame."""
        return (points_m - self.centre_m) @ self.world_from_camera
