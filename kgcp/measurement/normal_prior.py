"""What is known of the plate's attitude before the image is looked at.

The two poses of a circle have nearly the same image, and quite different normals. A plate that
lies level, in a camera whose attitude is known, makes one of them unlikely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, down_in_camera
from kgcp.geometry.pose import Pose

_ALONG_AXIS: FloatArray = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class NormalPrior:
    """Where the plate's normal should point.

    Attributes
    ----------
    direction_camera : (3,) array
        Unit vector in the camera frame, into the plate: the vertical, downwards.
    sd_deg : float
        Standard deviation of the normal about either axis square to it [deg].
    """

    direction_camera: FloatArray
    sd_deg: float

    def chi2(self, pose: Pose, rotation_cov: FloatArray) -> float:
        """Return how far the normal of a measured pose is from the expected one, as χ² (2 dof).

        dᵀ (S + sd² I)⁻¹ d with the turn d from one to the other and the covariance S of the
        measured normal: what the least χ² of both observations together is. Without S, far targets
        would be judged by the noise of their normals.

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


def normal_priors(
    frames: Sequence[str],
    poses: ReferencePoses | None,
    *,
    level_sd_deg: float,
    plumb_sd_deg: float | None,
) -> list[NormalPrior | None]:
    """Return for each frame what a level plate says about the normal in it.

    Parameters
    ----------
    frames : sequence of str
        Names as in the poses.
    poses : ReferencePoses or None
        Attitudes of the camera; one without deviation counts as exact.
    level_sd_deg : float
        Of the plate's normal against the vertical, about either horizontal axis [deg].
    plumb_sd_deg : float or None
        The same for the optical axis, of frames without a pose; None: nothing is known of them.
    """
    by_name: dict[str, NormalPrior | None] = {}
    if poses is not None:
        sd_angle_deg = np.zeros(len(poses.frames))
        if poses.sd_angle_deg is not None:
            sd_angle_deg = poses.sd_angle_deg
        by_name = {
            frame: NormalPrior(down, math.hypot(level_sd_deg, sd_deg))
            for frame, down, sd_deg in zip(
                poses.frames, down_in_camera(poses.opk_deg), sd_angle_deg, strict=True
            )
        }
    plumb = None
    if plumb_sd_deg is not None:
        plumb = NormalPrior(_ALONG_AXIS, math.hypot(level_sd_deg, plumb_sd_deg))
    return [by_name.get(frame, plumb) for frame in frames]
