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
class CameraVelocity:
    """Velocity of the projection centre while a rolling shutter reads a frame."""

    velocity_m_s: FloatArray  # (3,): in the world
    sd_m_s: float  # of each component


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """What is known of the camera's motion while a rolling shutter reads a frame."""

    rotation: SceneRotation  # of the scene, by the camera's rotation alone
    # None: unknown, with the standard deviation that the camera's settings give for the line of
    # sight
    velocity: CameraVelocity | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Readout:
    """Exposure times of n points by a rolling shutter, and the camera's motion meanwhile."""

    delay_s: FloatArray  # (n,): after the middle row, to whose moment the pose refers
    motion: CameraMotion
    # standard deviation of the apparent rotation of the scene, about each axis, by the camera's
    # shift if its velocity is unknown
    sd_shift_rad_s: float

    @classmethod
    def of(
        cls, camera: Camera, pixels: FloatArray, motion: CameraMotion | None = None
    ) -> Readout | None:
        """Return the readout of points at raw pixels (n, 2); None: all are exposed at once.

        Parameters
        ----------
        motion : CameraMotion, optional
            By default that of the camera's settings.
        """
        if not camera.readout_s:
            return None
        unknown = SceneRotation.unknown(camera)
        return cls(camera.delay_s(pixels), motion or CameraMotion(unknown), unknown.sd_rad_s)

    def velocity(self, distance_m: float) -> CameraVelocity:
        """Return the velocity, or the a-priori one for points at a mean distance."""
        return self.motion.velocity or CameraVelocity(np.zeros(3), distance_m * self.sd_shift_rad_s)

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

    def motion_sd_rad(self, distance_m: FloatArray) -> FloatArray:
        """Return the typical rotation (..., n) of points since the moment of the pose [rad].

        Parameters
        ----------
        distance_m : (..., n) array
            From the camera.
        """
        if self.readout is None:
            return np.zeros(len(self))
        motion = self.readout.motion
        turn_rad_s = float(np.linalg.norm(motion.rotation.velocity_rad_s))
        by_shift_rad_s = np.full_like(distance_m, self.readout.sd_shift_rad_s)
        if motion.velocity is not None:
            by_shift_m_s = np.linalg.norm([*motion.velocity.velocity_m_s, motion.velocity.sd_m_s])
            by_shift_rad_s = by_shift_m_s / distance_m
        speed = np.hypot(turn_rad_s, np.maximum(motion.rotation.sd_rad_s, by_shift_rad_s))
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
