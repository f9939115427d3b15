"""Positions over time: the vehicle on its ring road, the UAV above it.

All in a local Cartesian frame, east, north, up; the ring road is about its origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.trajectory import ENU_FROM_NED, body_to_ned
from kgcp.simulation.presets import SimulationSettings

ROAD_RADIUS_M = 180.0
FRAME_INTERVAL_S = 1.5
FRAMES_PER_CLIMB = 24  # one climb and descent
_SPEED_M_S = 7.0
_POINT_HEIGHT_M = 0.4

# A camera that looks down with north up in the image: x east, y south, z down.
_ENU_FROM_NADIR = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class VehicleStates:
    """The vehicle at n times."""

    position_enu_m: FloatArray  # (n, 3): trajectory point [m]
    # (n,): attitude against local level and true north [deg]
    roll_deg: FloatArray
    pitch_deg: FloatArray
    heading_deg: FloatArray

    @property
    def level_from_body(self) -> FloatArray:
        """Attitude (n, 3, 3): body axes against east, north, up at the vehicle, as columns."""
        return np.asarray(
            ENU_FROM_NED @ body_to_ned(self.roll_deg, self.pitch_deg, self.heading_deg)
        )


def drive(elapsed_s: FloatArray) -> VehicleStates:
    """Return the vehicle at times (n,) since the start [s].

    It follows the ring road anticlockwise at a slowly changing speed, over gentle waves of the
    road; it leans, nods and crabs a little.
    """
    along_m = _SPEED_M_S * elapsed_s + 6.0 * np.sin(0.11 * elapsed_s)
    angle = along_m / ROAD_RADIUS_M
    height_m = _POINT_HEIGHT_M + 0.15 * np.sin(0.05 * along_m)
    slope = 0.15 * 0.05 * np.cos(0.05 * along_m)
    position = np.column_stack(
        (ROAD_RADIUS_M * np.cos(angle), ROAD_RADIUS_M * np.sin(angle), height_m)
    )
    return VehicleStates(
        position,
        roll_deg=1.1 * np.sin(0.43 * elapsed_s) + 0.4,
        pitch_deg=np.degrees(np.arctan(slope)) + 0.5 * np.sin(0.61 * elapsed_s),
        heading_deg=np.mod(-np.degrees(angle) + 0.8 * np.sin(0.29 * elapsed_s), 360.0),
    )


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """Exterior orientation: camera → ENU."""

    enu_from_camera: FloatArray
    position_enu_m: FloatArray

    def pose_of(self, enu_from_plane: FloatArray, origin_enu_m: FloatArray) -> Pose:
        """Return the pose plane → camera of a plane given by its axes and origin in ENU."""
        camera_from_enu = self.enu_from_camera.T
        return Pose(
            camera_from_enu @ enu_from_plane, camera_from_enu @ (origin_enu_m - self.position_enu_m)
        )

    @property
    def ground(self) -> Pose:
        """Pose of the ground plane at height 0: x east, y south, z down."""
        return self.pose_of(_ENU_FROM_NADIR, np.zeros(3))


def climb(settings: SimulationSettings, index: int, rng: np.random.Generator) -> float:
    """Return the distance from camera to target in one frame [m]: up and down, with some jitter."""
    phase = (2.0 * (index + 0.5) / FRAMES_PER_CLIMB) % 2.0
    climbed = 1.0 - abs(1.0 - phase)
    low, high = np.log(settings.distance_m)
    jittered = climbed + rng.uniform(-0.5, 0.5) / FRAMES_PER_CLIMB
    return float(np.exp(low + (high - low) * np.clip(jittered, 0.0, 1.0)))


def hover(
    settings: SimulationSettings,
    target_enu_m: FloatArray,
    distance_m: float,
    plate_reach_m: float,
    rng: np.random.Generator,
    *,
    present: bool,
) -> CameraState:
    """Place the camera so that the target is anywhere in the frame, or just outside it.

    Parameters
    ----------
    target_enu_m : (3,) array
        Target centre [m].
    distance_m : float
        Of the camera from it [m].
    plate_reach_m : float
        Radius that must be inside the frame, or outside if the target is not `present` [m].
    """
    tilt_deg, azimuth, kappa = (
        rng.uniform(*settings.tilt_deg),
        rng.uniform(0.0, 2.0 * math.pi),
        rng.uniform(0.0, 360.0),
    )
    tilt = Rotation.from_rotvec(
        math.radians(tilt_deg) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    )
    spin = Rotation.from_euler("z", kappa, degrees=True)
    enu_from_camera = (tilt * spin).as_matrix() @ _ENU_FROM_NADIR
    camera = settings.camera
    reach_px = camera.mean_focal_px * plate_reach_m / distance_m
    pixel = (
        _pixel_inside(camera, reach_px, rng) if present else _pixel_outside(camera, reach_px, rng)
    )
    ray = np.append(camera.undistort(pixel[None])[0], 1.0)
    ray /= np.linalg.norm(ray)
    return CameraState(enu_from_camera, target_enu_m - distance_m * (enu_from_camera @ ray))


def _pixel_inside(camera: Camera, reach_px: float, rng: np.random.Generator) -> FloatArray:
    size = np.array([camera.width, camera.height], dtype=np.float64)
    margin = np.minimum(1.2 * reach_px + 4.0, 0.5 * size)
    return np.asarray(margin + rng.random(2) * (size - 2.0 * margin) - 0.5)


def _pixel_outside(camera: Camera, reach_px: float, rng: np.random.Generator) -> FloatArray:
    pixel = rng.random(2) * (camera.width, camera.height)
    axis = int(rng.integers(2))
    size = (camera.width, camera.height)[axis]
    beyond = 1.4 * reach_px + rng.uniform(0.02, 0.2) * size
    pixel[axis] = -beyond if rng.random() < 0.5 else size + beyond
    return pixel
