"""The expected normal of the vehicle's plate in a frame, before the frame is measured.

If the attitude of the camera is known, so is the direction of the plate's normal in the camera
frame: that of the vehicle's downward axis, or of the vertical for a level plate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses, down_in_camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.target_positions import Vehicle
from kgcp.georef.trajectory import Coverage
from kgcp.measurement.plate_prior import NormalPrior

_OPTICAL_AXIS: FloatArray = np.array([0.0, 0.0, 1.0])
_UNSTATED_MOUNT_SD_DEG = 3.0  # of a plate on a roof against the vehicle's axes, if none is given


@dataclass(frozen=True, slots=True, eq=False)
class CameraAttitudes:
    """What is known of the camera's attitude."""

    poses: ReferencePoses | None  # those without standard deviations count as exact
    # standard deviation of the optical axis from the vertical, about either horizontal axis, in
    # frames without a pose [deg]; None: their attitude is unknown
    plumb_sd_deg: float | None

    def sd_deg(self, row: int) -> float:
        """Return the standard deviation of a pose's attitude [deg]."""
        if self.poses is None or self.poses.sd_angle_deg is None:
            return 0.0
        return float(self.poses.sd_angle_deg[row])


def normal_priors(
    frames: Sequence[str],
    time_s: Sequence[float | None],
    attitudes: CameraAttitudes,
    vehicle: Vehicle | None,
    level_sd_deg: float | None,
) -> list[NormalPrior | None]:
    """Return for each frame in which direction the normal of the vehicle's plate should point.

    Within the trajectory it follows from the vehicle's attitude. Elsewhere the plate is taken as
    level if `level_sd_deg` is given.

    Parameters
    ----------
    frames : sequence of str
        Names as in the poses.
    time_s : sequence of float or None
        Times of the frames, Unix UTC [s]; None: not known yet.
    level_sd_deg : float or None
        Standard deviation of the plate's normal from the vehicle's downward axis, or from the
        vertical, about either horizontal axis [deg]; None: not given.
    """
    poses = attitudes.poses
    rows = {} if poses is None else {frame: row for row, frame in enumerate(poses.frames)}
    by_frame: dict[str, NormalPrior] = {}
    if poses is not None and level_sd_deg is not None:
        for frame, row in rows.items():
            sd_deg = math.hypot(level_sd_deg, attitudes.sd_deg(row))
            by_frame[frame] = NormalPrior(down_in_camera(poses.opk_deg[row, None])[0], sd_deg)
    if poses is not None and vehicle is not None:
        timed = {
            frame: time
            for frame, time in zip(frames, time_s, strict=True)
            if time is not None and frame in rows
        }
        by_frame |= _by_vehicle(timed, rows, attitudes, poses, vehicle, level_sd_deg)
    plumb = None
    if attitudes.plumb_sd_deg is not None and level_sd_deg is not None:
        plumb = NormalPrior(_OPTICAL_AXIS, math.hypot(level_sd_deg, attitudes.plumb_sd_deg))
    return [by_frame.get(frame, plumb) for frame in frames]


def _by_vehicle(
    time_s: Mapping[str, float],
    rows: Mapping[str, int],
    attitudes: CameraAttitudes,
    poses: ReferencePoses,
    vehicle: Vehicle,
    level_sd_deg: float | None,
) -> dict[str, NormalPrior]:
    """Return priors along the vehicle's downward axis, for frames within the trajectory."""
    times = np.array(list(time_s.values()), dtype=np.float64)
    inside = [kind is Coverage.INSIDE for kind in vehicle.coverage(times)]
    frames = [frame for frame, is_inside in zip(time_s, inside, strict=True) if is_inside]
    if not frames:
        return {}
    states = vehicle.motion.states(times[inside] + vehicle.settings.time_offset_s)
    tilt_sd_deg = np.zeros(len(frames))
    if states.sd_attitude_deg is not None:
        tilt_sd_deg = states.sd_attitude_deg[:, :2].max(axis=1)
    mount_sd_deg = _UNSTATED_MOUNT_SD_DEG if level_sd_deg is None else level_sd_deg
    orientations = ExteriorOrientations.of(poses, vehicle.local_frame)
    priors = {}
    for index, frame in enumerate(frames):
        row = rows[frame]
        down = orientations.enu_from_camera[row].T @ states.frame_from_body[index, :, 2]
        sd_deg = math.hypot(mount_sd_deg, attitudes.sd_deg(row), float(tilt_sd_deg[index]))
        priors[frame] = NormalPrior(down, sd_deg)
    return priors
