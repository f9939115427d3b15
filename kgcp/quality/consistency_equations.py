"""The equations of the comparison: discrepancies, their derivatives and their covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.interpolate import CubicSpline

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.attitude import cross_matrix, place_covariances
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions, camera_motions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, VehicleState
from kgcp.measurement.image_model.plate import Circles
from kgcp.measurement.image_model.rotation_displacement import pose_displacements
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.quality.corrections import READOUT

_MODEL_SD_M = 0.001  # of interpolation and rounding; keeps covariances regular
_UNSTATED_SD_M = 0.01  # of data without standard deviations; the residuals then set the scale
_STANDING_M_S = 0.2  # below this speed, the direction of the track is the vehicle's heading
_READOUT_STEP_S = 5e-4  # for numerical derivatives
_RING_SHARE = 0.01  # radius of a ring that stands for any other, of its distance
_MAX_INTERVAL_S = 5.0  # between camera positions through which its velocity is interpolated


@dataclass(frozen=True, slots=True, eq=False)
class ComparedFrame:
    """One frame in which the target's position is known both by the vehicle and by the camera."""

    sighting: Sighting
    pose: Pose  # of the sighting, target → camera
    time_s: float  # when the target's row was exposed, by the frames' clock, Unix UTC [s]
    position: TargetPosition  # by the vehicle
    vehicle_state: VehicleState
    row: int  # of the reference pose


@dataclass(frozen=True, slots=True, eq=False)
class ConsistencyEquations:
    """Discrepancies of n frames in ENU axes, with derivatives and covariances."""

    offset: FloatArray  # (n, 3): position by the vehicle minus position by the camera [m]
    # (n, 3, 10): change of the offset by a correction of one unit of each of the `UNKNOWNS`
    design: FloatArray
    correlated: FloatArray  # (n, 3, 3): covariance by the trajectory, correlated over time [m²]
    # (n, 3, 3): covariance by all errors that are independent from frame to frame [m²]
    independent: FloatArray
    # (n, 3): change of the offset by one standard deviation of calibration and diameter, which
    # change the distance [m]
    common: FloatArray
    # (n, 3, k): change of the offset by one standard deviation of errors of the reference poses
    # that all frames share [m]
    shared: FloatArray
    has_sds: bool  # whether trajectory and reference poses have standard deviations
    track: FloatArray  # (n, 3, 3): along the track, across it to the right and up, as rows
    enu_from_camera: FloatArray  # (n, 3, 3)
    # (n, 3): rotation of the line of sight about the camera's axes [rad/s]
    sight_turn_rad_s: FloatArray

    @classmethod
    def of(
        cls,
        frames: Sequence[ComparedFrame],
        orientations: ExteriorOrientations,
        camera: Camera,
        sd_time_s: float,
        motions: CameraMotions | None = None,
    ) -> Self:
        """Set up the equations of frames in the order of time.

        `motions` are those of a rolling shutter's camera at each pose; None: all rows are exposed
        at once.
        """
        rows = [frame.row for frame in frames]
        velocity = np.array([frame.vehicle_state.velocity_m_s for frame in frames])
        if motions is None:
            centres, axes = orientations.centre_m[rows], orientations.enu_from_camera[rows]
            camera_velocity = _camera_velocity(frames, centres, velocity)
            camera_turn = _own_motions(frames, centres, axes, camera).turn_rad_s
        else:
            camera_velocity, camera_turn = motions.velocity_m_s[rows], motions.turn_rad_s[rows]
            delays_s = np.array([frame.sighting.delay_s(camera) for frame in frames])
            orientations = motions.after(orientations, rows, delays_s)
            rows = [*range(len(frames))]
        attitude = orientations.enu_from_camera[rows]
        in_camera = np.array([frame.pose.translation_m for frame in frames])
        sight = np.einsum("nij,nj->ni", attitude, in_camera)
        body = np.array([frame.vehicle_state.frame_from_body for frame in frames])
        since_middle = np.array([frame.sighting.rows_since_middle(camera) for frame in frames])[
            :, None
        ]
        centre = orientations.centre_m[rows]
        offset = np.array([frame.position.position_m for frame in frames]) - centre - sight
        across_m_s = velocity - camera_velocity
        square = np.sum(sight**2, axis=1, keepdims=True)
        sight_turn = np.cross(sight, across_m_s) / square - camera_turn
        columns = (
            velocity[:, :, None],
            body,
            (since_middle * (across_m_s - np.cross(camera_turn, sight)))[:, :, None],
        )
        # The radius in the image gives the depth; pixel and depth give the rest. So a correction
        # of the diameter scales the whole translation, and one of the focal length the depth only.
        depth = attitude[:, :, 2] * in_camera[:, 2:]
        design = np.concatenate(
            (
                *columns,
                attitude @ cross_matrix(in_camera),
                -sight[:, :, None],
                -depth[:, :, None],
            ),
            axis=2,
        )
        correlated = np.array([_correlated_m2(frame.position) for frame in frames])
        independent = _independent_m2(frames, orientations, rows, sight)
        shift = sd_time_s * velocity
        independent = independent + shift[:, :, None] * shift[:, None, :]
        independent = independent + np.array(
            [_interpolation_m2(frame.position) for frame in frames]
        )
        common_m = np.array([frame.sighting.sd_common_distance_m or 0.0 for frame in frames])
        unit = sight / np.linalg.norm(sight, axis=1, keepdims=True)
        weights = 1.0 / np.trace(correlated + independent, axis1=1, axis2=2)
        stated = (
            all(frame.position.cov_m2 is not None for frame in frames)
            and orientations.states_centres
        )
        return cls(
            offset,
            design,
            correlated,
            independent,
            unit * common_m[:, None],
            _shared_by_poses(orientations, rows, sight, weights),
            stated,
            _track(velocity, body),
            attitude,
            np.einsum("nji,nj->ni", attitude, sight_turn),
        )

    def at_readouts(
        self,
        frames: Sequence[ComparedFrame],
        camera: Camera,
        excess_s: FloatArray,
        rows: IndexArray,
    ) -> list[Self]:
        """Return the equations as they are if `readout_s` is longer by each of some times (k,) [s].

        They are right in some rows only, which saves time.

        Not only the row of the target is exposed at another time, but also the rows of its ring,
        against each other: the image was sheared and stretched otherwise than was measured, and the
        target is nearer or farther. The distance is no linear function of that: an ellipse that is
        too long is nearer, one that is too short is tilted.
        """
        steps_s = excess_s[:, None] + _READOUT_STEP_S * np.array([0.0, -1.0, 1.0])
        moved = np.array(
            [
                _poses_unsheared(
                    frames[row], camera, steps_s.ravel()[:, None] * self.sight_turn_rad_s[row]
                )
                for row in rows.tolist()
            ]
        )
        moved = np.einsum("nij,nkj->kni", self.enu_from_camera[rows], moved)
        moved = moved.reshape(len(excess_s), 3, len(rows), 3)
        others = []
        for excess, (here, before, after) in zip(excess_s.tolist(), moved, strict=True):
            design = self.design.copy()
            offset = self.offset + excess * design[:, :, READOUT]
            offset[rows] -= here
            design[rows, :, READOUT] -= (after - before) / (2.0 * _READOUT_STEP_S)
            others.append(replace(self, offset=offset, design=design))
        return others


def _poses_unsheared(frame: ComparedFrame, camera: Camera, turns: FloatArray) -> FloatArray:
    """Return how far the target moves (k, 3) in the camera frame if its image is unsheared [m].

    Parameters
    ----------
    turns : (k, 3) array
        Rotations of the scene during the readout that the measurement has not taken into account
        [rad].
    """
    delay = camera.mean_focal_px / (camera.height - 1)  # per unit of y, in readouts
    circles = _small_ring(_RING_SHARE * frame.pose.distance_m)
    return pose_displacements(frame.pose, circles, delay, turns)[:, :3]


def _small_ring(radius_m: float) -> Circles:
    """Return a ring with four dots; what shears do to its distance hardly depends on its size."""
    dots = 0.7 * radius_m * np.array([[1.0, 0.0, -0.8, 0.0], [0.0, 1.0, -0.6, -1.0]])
    radii = radius_m * np.array([1.0, 0.1, 0.1, 0.1, 0.1])
    return Circles(np.hstack((np.zeros((2, 1)), dots)), radii, np.ones(5))


def _correlated_m2(position: TargetPosition) -> FloatArray:
    if position.cov_m2 is None or position.common_m is None:
        return _UNSTATED_SD_M**2 * np.eye(3)
    not_common = position.cov_m2 - position.common_m @ position.common_m.T
    return np.asarray(not_common - _interpolation_m2(position))


def _interpolation_m2(position: TargetPosition) -> FloatArray:
    interpolation = position.interpolation_m2
    return np.zeros((3, 3)) if interpolation is None else interpolation


def _independent_m2(
    frames: Sequence[ComparedFrame],
    orientations: ExteriorOrientations,
    rows: Sequence[int],
    sight: FloatArray,
) -> FloatArray:
    """Return the covariance (n, 3, 3) of reference poses and measured poses, in ENU axes."""
    attitude = orientations.enu_from_camera[[*rows]]
    total = np.broadcast_to(_MODEL_SD_M**2 * np.eye(3), attitude.shape)
    measured = [frame.sighting.pose_cov for frame in frames]
    of_pose = np.array([np.zeros((3, 3)) if cov is None else cov[:3, :3] for cov in measured])
    total = total + attitude @ of_pose @ np.swapaxes(attitude, 1, 2)
    total = total + orientations.place_covariances(rows, sight)
    if not orientations.states_centres:
        total = total + _UNSTATED_SD_M**2 * np.eye(3)
    return np.asarray(total)


def _shared_by_poses(
    orientations: ExteriorOrientations, rows: Sequence[int], sight: FloatArray, weights: FloatArray
) -> FloatArray:
    """Return the effects (n, 3, k) of errors that all poses share, by one standard deviation [m].

    Such poses mostly follow from a few points on the ground. Wrong points shift, turn and scale all
    that is seen, the cameras included: about a point O, a place moves by δ + ω × (P − O), and,
    since its distance from the camera C is measured, by s (C − O). How much of the poses' errors is
    common is unknown; therefore all of it is counted.

    Parameters
    ----------
    weights : (n,) array
        How much each frame counts in the comparison.
    """
    if orientations.cov is None or not orientations.has_correlations:
        return np.zeros((len(sight), 3, 0))
    cov = orientations.cov[[*rows]]
    length = np.linalg.norm(sight, axis=1)
    unit = sight / length[:, None]
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    shift = _mean_root(across @ place_covariances(cov, sight) @ across, weights)
    turn = _mean_root(cov[:, 3:, 3:], weights)
    along = np.einsum("ni,nij,nj->n", unit, cov[:, :3, :3], unit) / length**2
    scale = np.sqrt(np.average(along, weights=weights))
    camera = orientations.centre_m[[*rows]]
    place = camera + sight
    middle = place.mean(axis=0)
    return np.concatenate(
        (
            np.broadcast_to(shift, (len(sight), 3, 3)),
            -cross_matrix(place - middle) @ turn,
            scale * (camera - middle)[:, :, None],
        ),
        axis=2,
    )


def _mean_root(covs: FloatArray, weights: FloatArray) -> FloatArray:
    """Return L with L Lᵀ = the mean of covariances (n, 3, 3)."""
    values, vectors = np.linalg.eigh(np.average(covs, axis=0, weights=weights))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _camera_velocity(
    frames: Sequence[ComparedFrame], centre: FloatArray, vehicle_velocity: FloatArray
) -> FloatArray:
    """Return the camera's velocity (n, 3) by splines through its positions between gaps.

    A frame without neighbours has the vehicle's velocity.
    """
    time_s = np.array([frame.time_s for frame in frames])
    velocity = vehicle_velocity.copy()
    breaks = np.flatnonzero(np.diff(time_s) > _MAX_INTERVAL_S) + 1
    for run in np.split(np.arange(len(time_s)), breaks):
        if len(run) > 1 and np.all(np.diff(time_s[run]) > 0.0):
            velocity[run] = CubicSpline(time_s[run], centre[run])(time_s[run], 1)
    return velocity


def _own_motions(
    frames: Sequence[ComparedFrame], centre: FloatArray, axes: FloatArray, camera: Camera
) -> CameraMotions:
    """Return the camera's motion as these frames show it."""
    distances_m = [frame.sighting.distance_m for frame in frames]
    return camera_motions(
        np.array([frame.time_s for frame in frames]),
        centre,
        axes,
        [None] * len(frames),
        SceneRotation.unknown(camera),
        float(np.median(distances_m)),
    )


def _track(velocity: FloatArray, body: FloatArray) -> FloatArray:
    """Return unit vectors along the track, across it to the right, and up (n, 3, 3), as rows."""
    ahead = np.where(
        np.linalg.norm(velocity[:, :2], axis=1, keepdims=True) > _STANDING_M_S,
        velocity,
        body[:, :, 0],
    )
    east, north = (ahead[:, :2] / np.linalg.norm(ahead[:, :2], axis=1, keepdims=True)).T
    none, ones = np.zeros_like(east), np.ones_like(east)
    rows = ((east, north, none), (north, -east, none), (none, none, ones))
    return np.moveaxis(np.array(rows), 2, 0)
