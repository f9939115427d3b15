"""Exterior orientation of the camera from a moving plate: the vehicle tells how the plate lies.

The pose of the plate in the camera and the attitude of the vehicle that carries it give the
attitude of the camera; from the plate's place it is then one vector to the projection centre:

    R(map ← camera) = R(map ← body) R(body ← plate) R(camera ← plate)ᵀ
    X(camera)       = X(plate) − R(map ← camera) t

R(body ← plate) is the mount of docs/conventions.md. A small error of the plate's normal moves the
camera by the whole distance times that angle: these are priors, and their covariances say how weak.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.carrier import Carrier, Whereabouts
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.geometry.reference import CAMERA_FROM_PHOTO, opk_from_rotation
from kgcp.kgcps import Kgcp
from kgcp.mapframe import MapFrame
from kgcp.target.sighting import Sighting

MIN_AMBIGUITY = 2.0 * math.log(100.0)
"""Δχ² of the other pose from which on a pose counts as told apart: odds of 100 to 1."""

_BODY_FROM_LEVEL_PLATE: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Default mount: plate x = body y, plate y = −body x, plate z = body z, as columns."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraPrior:
    """Exterior orientation of one frame, as the plate and its vehicle tell it.

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
        are in it. None: the trajectory or the measurement has no deviations.
    """

    frame: str
    position_map: FloatArray
    map_from_camera: FloatArray
    cov: FloatArray | None

    @property
    def opk_deg(self) -> FloatArray:
        """Omega, phi, kappa (3,) [deg] as docs/conventions.md defines them."""
        opk: FloatArray = opk_from_rotation((self.map_from_camera @ CAMERA_FROM_PHOTO)[None])[0]
        return opk

    @property
    def opk_cov(self) -> FloatArray | None:
        """Covariance (6, 6) of x, y, z [m], omega, phi, kappa [deg]."""
        if self.cov is None:
            return None
        omega, phi, _ = np.radians(self.opk_deg)
        about_x = rotation_about(np.array([omega, 0.0, 0.0]))
        about_y = rotation_about(np.array([0.0, phi, 0.0]))
        axes = np.column_stack((np.eye(3)[0], about_x[:, 1], (about_x @ about_y)[:, 2]))
        change = np.eye(6)
        change[3:, 3:] = np.degrees(np.linalg.inv(axes))
        turned: FloatArray = change @ self.cov @ change.T
        return turned


def body_from_plate(mount_deg: float) -> FloatArray:
    """Return the plate's axes (3, 3) in body axes, as columns, for a turn from the default."""
    turn = rotation_about(np.array([0.0, 0.0, math.radians(mount_deg)]))
    mounted: FloatArray = _BODY_FROM_LEVEL_PLATE @ turn
    return mounted


def camera_priors(
    kgcps: Sequence[Kgcp],
    sightings: Sequence[Sighting],
    whereabouts: Whereabouts,
    frame: MapFrame,
) -> tuple[CameraPrior, ...]:
    """Orient the camera in every frame where the plate on the vehicle tells its attitude.

    Left out are static targets, whose attitude nobody knows, measurements without a pose, and
    those whose two poses cannot be told apart: the wrong one moves the camera by metres.

    Parameters
    ----------
    kgcps : sequence of Kgcp
    sightings : sequence of Sighting
        Of which the KGCPs were made.
    whereabouts : Whereabouts
        Of the flight's targets; without a vehicle there is no prior.
    frame : MapFrame
        Of the KGCPs' coordinates.
    """
    carrier = whereabouts.carrier
    if carrier is None:
        return ()
    seen = {(one.frame, one.target): one for one in sightings if one.instance == 0}
    chosen = [
        (point, seen[point.frame, point.target], point.time_s)
        for point in kgcps
        if point.time_s is not None
        and point.target not in whereabouts.static
        and _is_told_apart(seen[point.frame, point.target])
    ]
    if not chosen:
        return ()
    states = carrier.motion.states(np.array([time_s for _, _, time_s in chosen]))
    attitudes = _level_from_body(carrier, states.position_m, states.frame_from_body)
    sds = states.sd_attitude_deg
    return tuple(
        _prior(point, one, one.pose, attitudes[i], None if sds is None else sds[i], carrier, frame)
        for i, (point, one, _) in enumerate(chosen)
        if one.pose is not None
    )


def _is_told_apart(seen: Sighting) -> bool:
    return seen.ambiguity is None or seen.ambiguity >= MIN_AMBIGUITY


def _level_from_body(carrier: Carrier, position: FloatArray, attitude: FloatArray) -> FloatArray:
    """Return the rotations (n, 3, 3) from body axes to east, north, up at the vehicle."""
    level = carrier.frame.level_rotations(position)
    turned: FloatArray = np.swapaxes(level, -1, -2) @ attitude
    return turned


def _prior(
    point: Kgcp,
    seen: Sighting,
    pose: Pose,
    level_from_body: FloatArray,
    sd_attitude_deg: FloatArray | None,
    carrier: Carrier,
    frame: MapFrame,
) -> CameraPrior:
    plate = frame.enu_from_map(point.position_map[None])[0]
    enu_from_body = frame.level_rotations(plate[None])[0] @ level_from_body
    mount = body_from_plate(carrier.settings.mount_deg)
    enu_from_camera = enu_from_body @ mount @ pose.rotation.T
    camera = plate - enu_from_camera @ pose.translation_m
    map_from_enu = frame.grid_rotation(camera).T
    cov = None
    if point.cov_m2 is not None and seen.pose_cov is not None and sd_attitude_deg is not None:
        to_enu = frame.grid_rotation(plate)
        cov_enu = _cov(
            to_enu @ point.cov_m2 @ to_enu.T,
            seen.pose_cov if seen.common_pose_cov is None else seen.pose_cov + seen.common_pose_cov,
            _attitude_cov(enu_from_body, sd_attitude_deg),
            _mount_cov(enu_from_body, carrier.settings.level_sd_deg),
            enu_from_body @ np.array(carrier.settings.lever_arm_m),
            enu_from_camera,
            pose.translation_m,
        )
        turn = np.kron(np.eye(2), map_from_enu)
        cov = turn @ cov_enu @ turn.T
    position = frame.map_from_enu(camera[None])[0]
    return CameraPrior(point.frame, position, map_from_enu @ enu_from_camera, cov)


def _attitude_cov(enu_from_body: FloatArray, sd_deg: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of the vehicle's attitude as a left rotation in ENU [rad²].

    Roll turns about the body's x, heading about the vertical, pitch about the horizontal axis that
    is square to both.
    """
    forward, down = enu_from_body[:, 0], np.array([0.0, 0.0, -1.0])
    right = np.cross(down, forward)
    axes = np.column_stack((forward, right / np.linalg.norm(right), down))
    scaled = axes * np.radians(sd_deg)
    cov: FloatArray = scaled @ scaled.T
    return cov


def _mount_cov(enu_from_body: FloatArray, level_sd_deg: float | None) -> FloatArray:
    """Return the covariance (3, 3) of how the plate lies on its vehicle, in ENU [rad²].

    That the plate is level within `level_sd_deg` is the only thing known of its mount; none given
    counts as exact, as does `mount_deg`.
    """
    tilts = enu_from_body[:, :2] * math.radians(level_sd_deg or 0.0)
    cov: FloatArray = tilts @ tilts.T
    return cov


def _cov(
    cov_plate: FloatArray,
    cov_pose: FloatArray,
    cov_attitude: FloatArray,
    cov_mount: FloatArray,
    lever: FloatArray,
    enu_from_camera: FloatArray,
    translation: FloatArray,
) -> FloatArray:
    """Return the covariance (6, 6) of position [m] and left rotation [rad] in ENU, first order.

    With r = R t (camera → plate, in ENU), errors α of the vehicle's attitude and μ of the mount, ρ
    of the plate's place, and τ, δ of the pose (t + τ, exp(δ) R(camera ← plate)):

        rotation  α + μ − R δ
        position  ρ − (α + μ) × r − R (τ + t × δ)

    ρ holds the attitude's effect on the lever arm, α × lever, from which it correlates with α.
    """
    arm = _cross_matrix(enu_from_camera @ translation)
    from_pose = np.block(
        [
            [-enu_from_camera, -enu_from_camera @ _cross_matrix(translation)],
            [np.zeros((3, 3)), -enu_from_camera],
        ]
    )
    from_turn = np.vstack((arm, np.eye(3)))
    shared = np.zeros((6, 6))
    shared[:3] = -_cross_matrix(lever) @ cov_attitude @ from_turn.T
    cov: FloatArray = from_pose @ cov_pose @ from_pose.T
    cov = cov + from_turn @ (cov_attitude + cov_mount) @ from_turn.T + shared + shared.T
    cov[:3, :3] += cov_plate
    return cov


def _cross_matrix(vector: FloatArray) -> FloatArray:
    """Return [v]×, with [v]× w = v × w."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
