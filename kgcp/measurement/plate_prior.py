"""What is known of a plate before it is measured: how it lies, how fast it goes by, its tone curve.

The two poses of a circle have nearly the same image, and quite different normals. A plate that
lies level, or on a vehicle of known attitude, in a camera whose attitude is known, makes one of
them unlikely. And while a rolling shutter reads a plate, its image moves on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import null_space

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import ToneBase

_BELIEVED_CHI2 = 25.0  # 5 σ: beyond, what is known of the attitudes is wrong, and the image decides


@dataclass(frozen=True, slots=True, eq=False)
class NormalPrior:
    """Where the plate's normal should point."""

    # (3,): unit vector in the camera frame, into the plate: downwards for a level plate
    direction_camera: FloatArray
    sd_deg: float  # standard deviation of the normal about either axis square to it [deg]

    def chi2(self, pose: Pose, rotation_cov: FloatArray) -> float:
        """Return how far the normal of a measured pose is from the expected one, as χ² (2 dof).

        dᵀ (S + sd² I)⁻¹ d, with the rotation d from one to the other and the covariance S of the
        measured normal: the least χ² of both observations together. Without S, the noise of their
        normals would decide about far targets.

        Parameters
        ----------
        pose : Pose
        rotation_cov : (3, 3) array
            Of its rotation vector in the camera frame [rad²].
        """
        normal = pose.normal
        axis = np.cross(normal, self.direction_camera)
        sine, cosine = float(np.linalg.norm(axis)), float(normal @ self.direction_camera)
        across = null_space(normal[None])
        turn = across.T @ axis * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)
        cov = across.T @ rotation_cov @ across + math.radians(self.sd_deg) ** 2 * np.eye(2)
        return float(turn @ np.linalg.solve(cov, turn))

    def preference(self, pose: Pose, other: Pose, rotation_cov: FloatArray) -> float:
        """Return the χ² of the other pose minus that of this one, each limited to 5 σ.

        If both are farther off, neither is preferred: attitudes may be wrong.
        """
        own, others = (min(self.chi2(each, rotation_cov), _BELIEVED_CHI2) for each in (pose, other))
        return others - own


@dataclass(frozen=True, slots=True)
class SceneRotation:
    """How the scene turns about the camera while a rolling shutter reads it."""

    # Ω about the camera's axes x right, y down, z forward: a point X moves by Ω × X. It combines
    # the inverse of the camera's own rotation with the rotation of the line of sight to a moving
    # plate, or from a moving camera.
    velocity_rad_s: tuple[float, float, float]
    sd_rad_s: float  # standard deviation of each of the three

    @classmethod
    def unknown(cls, camera: Camera) -> Self:
        """Return what is known of a camera's motion without any observation."""
        return cls((0.0, 0.0, 0.0), math.radians(camera.motion_sd_deg_s))


@dataclass(frozen=True, slots=True)
class PlatePrior:
    """What is known of one target in one frame before it is measured."""

    # where its normal points; it helps to choose between the two poses
    normal: NormalPrior | None = None
    # None: nothing more than what `SceneRotation.unknown` says
    rotation: SceneRotation | None = None
    # what an unknown tone curve departs from, if other frames have told it
    tone_base: ToneBase | None = None
