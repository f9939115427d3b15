"""Records of the surveyor's instruments of a simulated flight: truth plus stated errors."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.trajectory import Trajectory
from kgcp.simulation.path import CameraState, drive
from kgcp.simulation.presets import SimulationSettings

_TRAJECTORY_INTERVAL_S = 0.05
_CORRELATION_S = 4.0  # of trajectory errors: neighbouring epochs share them, as in a real solution


def record_trajectory(
    settings: SimulationSettings,
    local_frame: LocalFrame,
    start_s: float,
    duration_s: float,
    rng: np.random.Generator,
) -> Trajectory:
    """Sample the vehicle's path, with errors that are correlated over time.

    Parameters
    ----------
    start_s : float
        Unix time of the first sample [s].
    duration_s : float
        From the first sample to the last [s].
    """
    elapsed_s = np.arange(0.0, duration_s + _TRAJECTORY_INTERVAL_S, _TRAJECTORY_INTERVAL_S)
    states = drive(elapsed_s)
    position_map = local_frame.map_from_enu(states.position_enu_m)
    attitude_deg = np.column_stack((states.roll_deg, states.pitch_deg, states.heading_deg))
    errors = _gauss_markov(rng, len(elapsed_s), 6)
    attitude_deg += errors[:, 3:] * settings.sd_attitude_deg
    attitude_deg[:, 2] %= 360.0
    return Trajectory(
        start_s + elapsed_s,
        position_map + errors[:, :3] * settings.sd_position_m,
        attitude_deg,
        np.tile(settings.sd_position_m, (len(elapsed_s), 1)),
        np.tile(settings.sd_attitude_deg, (len(elapsed_s), 1)),
    )


def _gauss_markov(rng: np.random.Generator, count: int, columns: int) -> FloatArray:
    """Return first-order Gauss-Markov processes (count, columns) of unit variance."""
    kept = np.exp(-_TRAJECTORY_INTERVAL_S / _CORRELATION_S)
    drive_noise = rng.standard_normal((count, columns))
    drive_noise[1:] *= np.sqrt(1.0 - kept * kept)
    return np.asarray(lfilter([1.0], [1.0, -kept], drive_noise, axis=0))


def adjust_reference(
    settings: SimulationSettings,
    local_frame: LocalFrame,
    frames: tuple[str, ...],
    cameras: tuple[CameraState, ...],
    rng: np.random.Generator,
) -> ReferencePoses:
    """Return the poses that an aerial triangulation would give, independent from frame to frame.

    Parameters
    ----------
    cameras : tuple of CameraState
        Their true exterior orientations.
    """
    position_enu_m = np.array([camera.position_enu_m for camera in cameras])
    grid_from_camera = np.array(
        [
            local_frame.grid_rotation(camera.position_enu_m).T @ camera.enu_from_camera
            for camera in cameras
        ]
    )
    n = len(cameras)
    turn = settings.sd_reference_deg * rng.standard_normal((n, 3))
    rotation = Rotation.from_rotvec(turn, degrees=True) * Rotation.from_matrix(
        grid_from_camera @ CAMERA_FROM_PHOTO
    )
    error_m = settings.sd_reference_m * rng.standard_normal((n, 3))
    return ReferencePoses(
        frames=frames,
        position_map=local_frame.map_from_enu(position_enu_m) + error_m,
        opk_deg=opk_from_rotation(rotation.as_matrix()),
        sd_position_m=np.full((n, 3), settings.sd_reference_m),
        sd_angle_deg=np.full(n, settings.sd_reference_deg),
    )
