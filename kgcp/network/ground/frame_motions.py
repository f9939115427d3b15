"""The camera's motion while a rolling shutter reads frames, by the frames' own poses and times.

Without it, every frame has to find its motion for itself, near the rest that the camera's settings
expect. A camera that flies on is three times as fast as that in all frames, which then agree on a
wrong focal length rather than on the motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.georef.scene_rotation import camera_motions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.network.ground.frame_poses import UNSTATED_SCALE_SD, FramePose, orient_frames
from kgcp.network.ground.point_images import CameraMotion, CameraVelocity
from kgcp.network.ground.resection import MIN_POINTS

NO_ROTATIONS: Mapping[str, SceneRotation] = MappingProxyType({})
"""No frame's rotation is known."""

# Poses show the motion if the standard deviation of a velocity is below this share of what the
# camera usually does, or may do a priori.
_KNOWN_SHARE = 0.5
# Between frames: a camera that stops for each of them needs longer, and one that sways turns to and
# fro in between.
_MAX_INTERVAL_S = 0.5


def orient_moving(
    frames: Sequence[str],
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    *,
    min_points: int = MIN_POINTS,
    has_free_focal: bool = False,
    sd_scale: float = UNSTATED_SCALE_SD,
    rotations: Mapping[str, SceneRotation] = NO_ROTATIONS,
) -> tuple[list[FramePose], Mapping[str, CameraMotion]]:
    """Return the poses of frames, and what is known of the camera's motion in them.

    If the shutter is rolling, the poses of a first pass show how the camera moved in the second.

    Parameters
    ----------
    rotations : mapping of str to SceneRotation
        Known rotations of the scene during the readout, by the camera's rotation alone, by frame.
    frames, sightings, positions, camera, min_points, has_free_focal, sd_scale
        As for `orient_frames`.
    """
    oriented = partial(
        orient_frames,
        frames,
        sightings,
        positions,
        camera,
        min_points=min_points,
        has_free_focal=has_free_focal,
        sd_scale=sd_scale,
    )
    by_rates = motions_by_rates(rotations)
    poses = oriented(motions=by_rates)
    by_poses = _motions_by_poses(poses, sightings, camera, rotations)
    return (oriented(motions=by_poses), by_poses) if by_poses else (poses, by_rates)


def motions_by_rates(rotations: Mapping[str, SceneRotation]) -> dict[str, CameraMotion]:
    """Return what the camera's rates show by frame: nothing of its velocity.

    Parameters
    ----------
    rotations : mapping of str to SceneRotation
        Of the scene, by the camera's rotation alone.
    """
    return {frame: CameraMotion(rotation) for frame, rotation in rotations.items()}


def _motions_by_poses(
    poses: Sequence[FramePose],
    sightings: Sequence[Sighting],
    camera: Camera,
    rotations: Mapping[str, SceneRotation],
) -> dict[str, CameraMotion]:
    """Return the motions by frame that poses and times before and after determine.

    Parameters
    ----------
    poses : sequence of FramePose
        Those by one ring do not count: they are much weaker.
    sightings : sequence of Sighting
        With the frames' times.
    rotations : mapping of str to SceneRotation
        As for `motions_by_rates`.
    """
    time_s = {each.frame: each.time_s for each in sightings if each.time_s is not None}
    posed = [
        (pose.frame, pose.pose)
        for pose in poses
        if pose.pose is not None and not pose.is_by_one_ring and pose.frame in time_s
    ]
    times_s = np.unique([time_s[frame] for frame, _ in posed])
    if not camera.readout_s or len(times_s) < 2 or np.median(np.diff(times_s)) > _MAX_INTERVAL_S:
        return {}
    distance_m = float(np.median([each.distance_m for each in sightings]))
    at_rest = SceneRotation.unknown(camera)
    centre_m = np.array([pose.centre_m for _, pose in posed])
    enu_from_camera = np.array([pose.world_from_camera for _, pose in posed])
    motions = camera_motions(
        np.array([time_s[frame] for frame, _ in posed]),
        centre_m,
        enu_from_camera,
        [rotations.get(frame) for frame, _ in posed],
        at_rest,
        distance_m,
    )
    usual_m_s = math.sqrt(float(np.mean(motions.velocity_m_s**2)))
    usual_m_s = max(usual_m_s, at_rest.sd_rad_s * distance_m)
    if not motions.sd_velocity_m_s.min() < _KNOWN_SHARE * usual_m_s:
        return {}
    # the scene turns opposite to the camera
    turns = -np.einsum("nji,nj->ni", enu_from_camera, motions.turn_rad_s)
    known = {
        frame: CameraMotion(
            SceneRotation((x, y, z), float(motions.sd_turn_rad_s[row])),
            CameraVelocity(motions.velocity_m_s[row], float(motions.sd_velocity_m_s[row])),
        )
        for row, ((frame, _), (x, y, z)) in enumerate(zip(posed, turns.tolist(), strict=True))
    }
    # other frames are read from a camera that is likely as fast
    unknown = CameraMotion(at_rest, CameraVelocity(np.zeros(3), usual_m_s))
    return {
        pose.frame: known.get(pose.frame)
        or replace(unknown, rotation=rotations.get(pose.frame, at_rest))
        for pose in poses
    }
