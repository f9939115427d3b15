"""Exterior orientation of the camera from the plate on a vehicle of known attitude.

The pose of the plate in the camera and the attitude of the vehicle give the attitude of the camera.
The measured vector from the projection centre to the plate then gives the projection centre:

    R(map ← camera) = R(map ← body) R(body ← plate) R(camera ← plate)ᵀ
    X(camera)       = X(plate) − R(map ← camera) t

R(body ← plate) is the mount of docs/conventions.md. A small error of the plate's normal moves the
camera by the distance times that angle. The results are therefore priors only, to be weighted by
their covariances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import (
    CAMERA_FROM_PHOTO,
    attitude_axes,
    covariance_along,
    cross_matrix,
    opk_from_rotation,
)
from kgcp.geometry.pose import rotation_about_once
from kgcp.georef.gcp import Gcp
from kgcp.georef.interpolation_error import interpolation_errors
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions, Vehicle
from kgcp.settings import VehicleSettings

MIN_AMBIGUITY = 2.0 * math.log(100.0)
"""Least Δχ² of the other pose at which a pose counts as unambiguous: odds of 100 to 1."""

BODY_FROM_LEVEL_PLATE: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Default mount: plate x = body y, plate y = −body x, plate z = body z, as columns."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPrior:
    """Exterior orientation of one frame, derived from the plate and its vehicle.

    Attributes
    ----------
    frame : str
        As in the sighting.
    position_map : (3,) array
        Projection centre x, y, z in the KGCPs' CRS.
    map_from_camera : (3, 3) array
        Camera axes (x right, y down, z forward) along the map's axes, as columns.
    cov : (6, 6) array or None
        Position along the map's axes [m], then a small rotation about the map's axes, applied to
        `map_from_camera` from the left [rad]. Errors that all frames share (calibration, print)
        are included. None: trajectory or measurement have no standard deviations.
    """

    frame: str
    position_map: FloatArray
    map_from_camera: FloatArray
    cov: FloatArray | None


def opk_deg(priors: Sequence[CameraPrior]) -> FloatArray:
    """Return omega, phi, kappa (n, 3) [deg] as docs/conventions.md defines them."""
    rotations = np.array([prior.map_from_camera for prior in priors]).reshape(-1, 3, 3)
    return opk_from_rotation(rotations @ CAMERA_FROM_PHOTO)


def opk_covs(priors: Sequence[CameraPrior]) -> list[FloatArray | None]:
    """Return the covariances (6, 6) of x, y, z [m], omega, phi, kappa [deg]; None: not known.

    R = Rx(ω) Ry(φ) Rz(κ) rotates about x, then about y as turned by ω, then about z as turned by
    both.
    """
    omega, phi, _ = np.radians(opk_deg(priors)).T
    zero, one = np.zeros_like(omega), np.ones_like(omega)
    sin, cos = np.sin(omega), np.cos(omega)
    about_y = np.stack((zero, cos, sin), axis=-1)
    about_z = np.stack((np.sin(phi), -sin * np.cos(phi), cos * np.cos(phi)), axis=-1)
    axes = np.stack((np.stack((one, zero, zero), axis=-1), about_y, about_z), axis=-1)
    change = np.tile(np.eye(6), (len(priors), 1, 1))
    change[:, 3:, 3:] = np.degrees(np.linalg.inv(axes))
    return [
        None if prior.cov is None else matrix @ prior.cov @ matrix.T
        for prior, matrix in zip(priors, change, strict=True)
    ]


def body_from_plate(mount_deg: float) -> FloatArray:
    """Return the plate's axes (3, 3) in body axes, as columns, turned from the default mount."""
    turn = rotation_about_once(np.array([0.0, 0.0, math.radians(mount_deg)]))
    return np.asarray(BODY_FROM_LEVEL_PLATE @ turn)


def camera_priors(
    gcps: Sequence[Gcp],
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    local_frame: LocalFrame,
) -> tuple[CameraPrior, ...]:
    """Orient the camera in every frame in which the plate on the vehicle determines its attitude.

    Three kinds of sightings give no prior: static targets, because their attitude is unknown;
    measurements without a pose; and ambiguous poses, because the wrong one moves the camera by
    metres.

    Parameters
    ----------
    sightings : sequence of Sighting
        From which the KGCPs were made.
    target_positions : TargetPositions
        Of the flight's targets. Without a vehicle there are no priors.
    local_frame : LocalFrame
        Of the KGCPs' coordinates.
    """
    vehicle = target_positions.vehicle
    if vehicle is None:
        return ()
    sighting_of = {(each.frame, each.target): each for each in sightings if each.instance == 0}
    chosen = [
        (point, sighting_of[point.frame, point.target], point.time_s)
        for point in gcps
        if point.time_s is not None
        and point.target not in target_positions.static
        and _is_pose_unambiguous(sighting_of[point.frame, point.target])
    ]
    if not chosen:
        return ()
    times = np.array([time_s for _, _, time_s in chosen])
    pairs = [(point, sighting) for point, sighting, _ in chosen]
    return _oriented(pairs, times, vehicle, local_frame)


def _is_pose_unambiguous(sighting: Sighting) -> bool:
    is_clear = sighting.ambiguity is None or sighting.ambiguity >= MIN_AMBIGUITY
    return sighting.pose is not None and is_clear


def _oriented(
    pairs: Sequence[tuple[Gcp, Sighting]],
    time_s: FloatArray,
    vehicle: Vehicle,
    local_frame: LocalFrame,
) -> tuple[CameraPrior, ...]:
    """Orient the camera in frames with a pose at times (n,) by the trajectory's clock [s]."""
    states = vehicle.motion.states(time_s)
    level = vehicle.local_frame.level_rotations(states.position_m)
    plate = local_frame.enu_from_map(np.array([point.position_map for point, _ in pairs]))
    # East, north and up are those at the plate, so that the datum of the points' CRS has no effect.
    enu_from_frame = local_frame.level_rotations(plate) @ np.swapaxes(level, -1, -2)
    enu_from_body = enu_from_frame @ states.frame_from_body
    poses = [sighting.pose for _, sighting in pairs if sighting.pose is not None]
    plate_from_camera = np.swapaxes(np.array([pose.rotation for pose in poses]), -1, -2)
    mount = body_from_plate(vehicle.settings.mount_deg)
    enu_from_camera = enu_from_body @ mount @ plate_from_camera
    rays = np.array([pose.translation_m for pose in poses])
    camera = plate - np.einsum("nij,nj->ni", enu_from_camera, rays)
    map_from_enu = np.swapaxes(local_frame.grid_rotation(camera), -1, -2)
    to_enu = local_frame.grid_rotation(plate)
    positions = local_frame.map_from_enu(camera)
    sds = states.sd_attitude_deg
    cov_turns = interpolation_errors(vehicle.motion, time_s).cov_turn_rad2
    priors = []
    for i, (point, sighting) in enumerate(pairs):
        cov = None
        cov_pose = _whole_pose_cov(sighting)
        if point.cov_m2 is not None and cov_pose is not None and sds is not None:
            cov_plate = to_enu[i] @ point.cov_m2 @ to_enu[i].T
            cov_turn = enu_from_frame[i] @ cov_turns[i] @ enu_from_frame[i].T
            attitude = _Attitude(enu_from_body[i], sds[i], cov_turn, vehicle.settings)
            turn = np.kron(np.eye(2), map_from_enu[i])
            cov = turn @ _cov(cov_plate, cov_pose, attitude, enu_from_camera[i], rays[i]) @ turn.T
        attitude_map = map_from_enu[i] @ enu_from_camera[i]
        priors.append(CameraPrior(point.frame, positions[i], attitude_map, cov))
    return tuple(priors)


def _whole_pose_cov(sighting: Sighting) -> FloatArray | None:
    """Return the pose's covariance with the errors that all frames share; None: not known."""
    if sighting.pose_cov is None or sighting.common_pose_cov is None:
        return sighting.pose_cov
    return np.asarray(sighting.pose_cov + sighting.common_pose_cov)


@dataclass(frozen=True, slots=True, eq=False)
class _Attitude:
    """The vehicle's attitude at one time, with its uncertainty."""

    enu_from_body: FloatArray  # (3, 3): body axes in ENU, as columns
    sd_deg: FloatArray  # (3,): of roll, pitch, heading
    # (3, 3): covariance of the interpolation's error, a small rotation about ENU axes
    cov_turn_rad2: FloatArray
    settings: VehicleSettings


def _cov(
    cov_plate: FloatArray,
    cov_pose: FloatArray,
    vehicle: _Attitude,
    enu_from_camera: FloatArray,
    translation: FloatArray,
) -> FloatArray:
    """Return the covariance (6, 6) of position [m] and left rotation [rad] in ENU, first order.

    Let r = R t be the vector from camera to plate in ENU. The errors are α of the vehicle's
    attitude, μ of the mount, ρ of the plate's position, and τ, δ of the pose
    (t + τ, exp(δ) R(camera ← plate)). The errors of the result are

        rotation  α + μ − R δ
        position  ρ − (α + μ) × r − R (τ + t × δ)

    ρ includes the attitude's effect on the lever arm, α × lever; it is therefore correlated with α.
    """
    body = vehicle.enu_from_body
    (turns,) = attitude_axes(body[None], np.array([[0.0, 0.0, -1.0]]))
    cov_attitude = covariance_along(turns, np.radians(vehicle.sd_deg)) + vehicle.cov_turn_rad2
    # Only the mount's tilt has a standard deviation. Without one it counts as exact; its rotation
    # about the plate's normal always does.
    tilt_sd = math.radians(vehicle.settings.level_sd_deg or 0.0)
    cov_mount = covariance_along(body[:, :2], np.full(2, tilt_sd))
    lever = body @ np.array(vehicle.settings.lever_arm_m)
    sight = cross_matrix(enu_from_camera @ translation)
    from_pose = np.block(
        [
            [-enu_from_camera, -enu_from_camera @ cross_matrix(translation)],
            [np.zeros((3, 3)), -enu_from_camera],
        ]
    )
    from_turn = np.vstack((sight, np.eye(3)))
    shared = np.zeros((6, 6))
    shared[:3] = -cross_matrix(lever) @ cov_attitude @ from_turn.T
    cov: FloatArray = from_pose @ cov_pose @ from_pose.T
    cov = cov + from_turn @ (cov_attitude + cov_mount) @ from_turn.T + shared + shared.T
    cov[:3, :3] += cov_plate
    return cov
