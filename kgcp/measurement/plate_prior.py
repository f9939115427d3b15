"""What is known of a plate before it is measured: its normal, its motion, and the tone curve.

The two poses of a circle have nearly the same image, but quite different normals. If the camera's
attitude is known, and the plate is level or on a vehicle of known attitude, one of the two is
unlikely. The motion is needed because the image moves on while a rolling shutter reads it.
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

# Limit of each χ², 5 σ. If both normals are farther off, the attitudes are wrong: the image decides
_MOST_CHI2 = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class NormalPrior:
    """Where the plate's normal should point."""

    # (3,): unit vector in the camera frame, into the plate: downwards for a level plate
    direction_camera: FloatArray
    sd_deg: float  # standard deviation of the normal about either axis perpendicular to it [deg]

    def chi2(self, pose: Pose, rotation_cov: FloatArray) -> float:
        """Return how far the normal of a measured pose is from the expected one, as χ² (2 dof).

        It is dᵀ (S + sd² I)⁻¹ d, with the rotation d from one normal to the other and the
        covariance S of the measured one: the least χ² of both observations together. Without S, the
        noise of the normal would decide between the poses of far targets.

        Parameters
        ----------
        pose : Pose
        rotation_cov : (3, 3) array
            Covariance of its rotation vector in the camera frame [rad²].
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

        If both are farther off, neither is preferred: attitudes are wrong.
        """
        own, others = (min(self.chi2(each, rotation_cov), _MOST_CHI2) for each in (pose, other))
        return others - own


@dataclass(frozen=True, slots=True)
class SceneRotation:
    """How the scene turns about the camera while a rolling shutter reads it."""

    # Ω about the camera's axes x right, y down, z forward: a point X moves with the velocity Ω × X.
    # It combines the inverse of the camera's own rotation with the rotation of the line of sight to
    # a moving plate, or from a moving camera.
    velocity_rad_s: tuple[float, float, float]
    sd_rad_s: float  # standard deviation of each component

    @classmethod
    def unknown(cls, camera: Camera) -> Self:
        """Return what is known of a camera's motion without any observation."""
        return cls((0.0, 0.0, 0.0), math.radians(camera.motion_sd_deg_s))


@dataclass(frozen=True, slots=True)
class PlatePrior:
    """What is known of one target in one frame before it is measured."""

    # its normal, which helps to choose between the two poses
    normal: NormalPrior | None = None
    # None: `SceneRotation.unknown`
    rotation: SceneRotation | None = None
    # base of an unknown tone curve, if other frames have shown it
    tone_base: ToneBase | None = None
