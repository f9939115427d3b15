"""Comparison of a target on a vehicle with the static targets by which frames are oriented.

The frames show where the vehicle's target is among the static ones. Errors of a pose's position and
rotation nearly cancel there, so that this place is more certain than the poses themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import place_covariances
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import CAMERA_SPEED_M_S, Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import FramePose

_MAX_SDS = 5.0  # of an offset in one frame
_MIN_OFF_M = 0.03  # of an offset that counts
_MIN_SHARE, _MIN_FRAMES = 0.25, 2  # of the frames that are compared, that must be off
_UNSTATED_SD_M = 0.1  # of a trajectory without standard deviations
_CALIBRATION_SD_PX = 0.5  # of a place relative to those of the static targets


@dataclass(frozen=True, slots=True, eq=False)
class VehicleOff:
    """A target that is not where trajectory and lever arm put it.

    Attributes
    ----------
    target : str
    beside_m : float
        Horizontal offset; the median of the frames in which it is off.
    above_m : float
        How far above it is by the images; the median likewise.
    frames : int
        In how many frames it is off.
    compared : int
        Number of frames that were compared.
    """

    target: str
    beside_m: float
    above_m: float
    frames: int
    compared: int


def vehicle_off(
    poses: Sequence[FramePose],
    on_vehicle: Mapping[str, tuple[Sighting, TargetPosition]],
    camera: Camera,
    sd_scale: float,
) -> VehicleOff | None:
    """Return by how much images and trajectory differ; None: as much as they may.

    Parameters
    ----------
    on_vehicle : mapping of str to (Sighting, TargetPosition)
        The vehicle's target by frame, and its place by the trajectory, in the poses' ENU frame.
    sd_scale : float
        Relative standard deviation of the targets' diameters.
    """
    compared, off_m, target = 0, [], ""
    for pose in poses:
        if pose.residuals is None or pose.frame not in on_vehicle:
            continue
        sighting, position = on_vehicle[pose.frame]
        found = _offset(pose, sighting, position, camera, sd_scale)
        if found is None:
            continue
        compared, target = compared + 1, sighting.target
        offset, cov = found
        is_off = float(offset @ np.linalg.solve(cov, offset)) > _MAX_SDS**2
        if is_off and np.linalg.norm(offset) > _MIN_OFF_M:
            off_m.append(offset)
    if len(off_m) < max(_MIN_FRAMES, _MIN_SHARE * compared):
        return None
    beside_m = float(np.median(np.linalg.norm(np.array(off_m)[:, :2], axis=1)))
    above_m = float(np.median(np.array(off_m)[:, 2]))
    return VehicleOff(target, beside_m, above_m, len(off_m), compared)


def _offset(
    pose: FramePose,
    sighting: Sighting,
    position: TargetPosition,
    camera: Camera,
    sd_scale: float,
) -> tuple[FloatArray, FloatArray] | None:
    """Return the place by the image minus that by the trajectory, and its covariance, ENU."""
    if pose.pose is None or pose.cov is None:
        return None
    if sighting.pose is None or sighting.pose_cov is None:
        return None
    axes = pose.pose.world_from_camera
    sight_m = axes @ sighting.pose.translation_m
    share = max(sd_scale, (sighting.sd_common_distance_m or 0.0) / sighting.distance_m)
    sd_m = _CALIBRATION_SD_PX * sighting.distance_m / camera.mean_focal_px
    shift_m = CAMERA_SPEED_M_S * camera.readout_s * sighting.rows_since_middle(camera)
    own = position.cov_m2
    cov = (
        place_covariances(pose.cov, sight_m)
        + axes @ sighting.pose_cov[:3, :3] @ axes.T
        + share**2 * np.outer(sight_m, sight_m)
        + (sd_m**2 + shift_m**2) * np.eye(3)
        + (_UNSTATED_SD_M**2 * np.eye(3) if own is None else own)
    )
    return pose.pose.centre_m + sight_m - position.position_m, cov
