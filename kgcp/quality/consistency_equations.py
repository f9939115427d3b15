"""The equations of the comparison: discrepancies, what moves them, and how well they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.interpolate import CubicSpline

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, cross_matrix
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, VehicleState

_MODEL_SD_M = 0.001  # interpolation and rounding; keeps covariances regular
_UNSTATED_SD_M = 0.01  # of what states none; the residuals set the scale then
_STANDING_M_S = 0.2  # below, the track is where the vehicle points
_NEIGHBOUR_S = 5.0  # over which a camera's velocity shows in its positions


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """One frame in which the target's place is known twice."""

    sighting: Sighting
    pose: Pose  # of the sighting, target → camera
    time_s: float  # when the target's row was exposed, by the frames' clock, Unix UTC [s]
    position: TargetPosition  # by the vehicle
    vehicle_state: VehicleState
    row: int  # of the reference pose


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Discrepancies of n meetings in ENU axes, and everything that they are made of."""

    offset: FloatArray  # (n, 3): place by the vehicle minus place by the camera [m]
    # (n, 3, 8): what one unit of each of the `UNKNOWNS`, as a correction, adds to it
    design: FloatArray
    # (n, 3, 3): covariance by the trajectory, and by all that is independent from frame to frame
    # [m²]
    fading: FloatArray
    white: FloatArray
    # (n, 3): what one standard deviation of calibration and diameter, by way of the distance, adds
    # to it [m]
    common: FloatArray
    has_sds: bool  # whether trajectory and reference poses have standard deviations
    track: FloatArray  # (n, 3, 3): along the track, across it to the right and up, as rows

    @classmethod
    def of(
        cls,
        meetings: Sequence[Meeting],
        orientations: ExteriorOrientations,
        poses: ReferencePoses,
        camera: Camera,
        sd_time_s: float,
    ) -> Self:
        """Set up the system of meetings, in their order in time."""
        rows = [meeting.row for meeting in meetings]
        attitude = orientations.enu_from_camera[rows]
        in_camera = np.array([meeting.pose.translation_m for meeting in meetings])
        sight = np.einsum("nij,nj->ni", attitude, in_camera)
        velocity = np.array([meeting.vehicle_state.velocity_m_s for meeting in meetings])
        body = np.array([meeting.vehicle_state.frame_from_body for meeting in meetings])
        since_middle = np.array(
            [meeting.sighting.rows_since_middle(camera) for meeting in meetings]
        )[:, None]
        moved = _camera_velocity(meetings, orientations.centre_m[rows], velocity)
        centre = orientations.centre_m[rows] + moved * since_middle * camera.readout_s
        offset = np.array([meeting.position.position_m for meeting in meetings]) - centre - sight
        columns = (velocity[:, :, None], body, (since_middle * (velocity - moved))[:, :, None])
        design = np.concatenate((*columns, attitude @ cross_matrix(in_camera)), axis=2)
        fading = np.array([_fading_m2(meeting.position) for meeting in meetings])
        white = _white_m2(meetings, orientations, poses, sight)
        shift = sd_time_s * velocity
        white = white + shift[:, :, None] * shift[:, None, :]
        white = white + np.array([_interpolation_m2(meeting.position) for meeting in meetings])
        common_m = np.array([meeting.sighting.sd_common_distance_m or 0.0 for meeting in meetings])
        unit = sight / np.linalg.norm(sight, axis=1, keepdims=True)
        stated = (
            all(meeting.position.cov_m2 is not None for meeting in meetings)
            and orientations.cov_m2 is not None
        )
        return cls(
            offset, design, fading, white, unit * common_m[:, None], stated, _track(velocity, body)
        )


def _fading_m2(position: TargetPosition) -> FloatArray:
    if position.cov_m2 is None or position.common_m is None:
        return _UNSTATED_SD_M**2 * np.eye(3)
    lasting = position.cov_m2 - position.common_m @ position.common_m.T
    return np.asarray(lasting - _interpolation_m2(position))


def _interpolation_m2(position: TargetPosition) -> FloatArray:
    between = position.interpolation_m2
    return np.zeros((3, 3)) if between is None else between


def _white_m2(
    meetings: Sequence[Meeting],
    orientations: ExteriorOrientations,
    poses: ReferencePoses,
    sight: FloatArray,
) -> FloatArray:
    """Return the covariance (n, 3, 3) of reference poses and measured poses, in ENU axes."""
    rows = [meeting.row for meeting in meetings]
    attitude = orientations.enu_from_camera[rows]
    total = np.broadcast_to(_MODEL_SD_M**2 * np.eye(3), attitude.shape)
    measured = [meeting.sighting.pose_cov for meeting in meetings]
    of_pose = np.array([np.zeros((3, 3)) if cov is None else cov[:3, :3] for cov in measured])
    total = total + attitude @ of_pose @ np.swapaxes(attitude, 1, 2)
    unstated = _UNSTATED_SD_M**2 * np.eye(3)
    total = total + (unstated if orientations.cov_m2 is None else orientations.cov_m2[rows])
    if poses.sd_angle_deg is not None:
        effect = cross_matrix(sight) * np.radians(poses.sd_angle_deg[rows])[:, None, None]
        total = total + effect @ np.swapaxes(effect, 1, 2)
    return np.asarray(total)


def _camera_velocity(
    meetings: Sequence[Meeting], centre: FloatArray, otherwise: FloatArray
) -> FloatArray:
    """Return the camera's velocity (n, 3) by splines through its positions, not across gaps.

    Where there is nothing to interpolate it is taken to follow the vehicle.
    """
    time_s = np.array([meeting.time_s for meeting in meetings])
    velocity = otherwise.copy()
    breaks = np.flatnonzero(np.diff(time_s) > _NEIGHBOUR_S) + 1
    for run in np.split(np.arange(len(time_s)), breaks):
        if len(run) > 1 and np.all(np.diff(time_s[run]) > 0.0):
            velocity[run] = CubicSpline(time_s[run], centre[run])(time_s[run], 1)
    return velocity


def _track(velocity: FloatArray, body: FloatArray) -> FloatArray:
    """Return along track, across to the right and up (n, 3, 3), as rows in ENU axes."""
    ahead = np.where(
        np.linalg.norm(velocity[:, :2], axis=1, keepdims=True) > _STANDING_M_S,
        velocity,
        body[:, :, 0],
    )
    east, north = (ahead[:, :2] / np.linalg.norm(ahead[:, :2], axis=1, keepdims=True)).T
    none, ones = np.zeros_like(east), np.ones_like(east)
    rows = ((east, north, none), (north, -east, none), (none, none, ones))
    return np.moveaxis(np.array(rows), 2, 0)
