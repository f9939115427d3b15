"""Frames in which a target's position is known twice: by its vehicle, and by camera and reference.

They differ from the frames of `consistency` in that any input can be replaced, to try slips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import TargetPositions, Vehicle
from kgcp.georef.trajectory import (
    ENU_FROM_NED,
    Motion,
    body_to_ned,
    roll_pitch_heading_deg,
)

MIN_ENCOUNTERS = 5
_MAX_ENCOUNTERS = 80  # more tell nothing new about slips, which are the same in all frames
_RUN = 10  # consecutive frames, because times may be those of the next frame
_MIN_SD_M = 0.01  # of a coordinate: models, and inputs without standard deviations
_MEDIAN_CHI2 = 2.366  # of three coordinates
_MAX_GAP_INTERVALS = 4.0  # longest interval that is interpolated, in medians of the interval
_MIN_COVERED_SHARE = 0.6  # of the encounters that must be inside the trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Encounters:
    """Data of n frames with a moving target; inputs can be replaced, to undo slips."""

    vehicle: Vehicle
    camera: Camera
    time_s: FloatArray  # (n,): of the target's row, by the trajectory's clock, ascending [s]
    position_m: FloatArray  # (n, 3): trajectory point in the ENU frame [m]; NaN: not covered
    attitude_deg: FloatArray  # (n, 3): roll, pitch, heading [deg]
    lever_arm_m: FloatArray  # (3,): in body axes [m]
    pixel: FloatArray  # (n, 2): measured centres [px]
    in_camera_m: FloatArray  # (n, 3): measured centres in the camera frame [m]
    camera_from_plate: FloatArray  # (n, 3, 3): measured attitude of the plate
    centre_m: FloatArray  # (n, 3): reference projection centres in the ENU frame [m]
    enu_from_camera: FloatArray  # (n, 3, 3)
    opk_deg: FloatArray  # (n, 3): reference attitude as the file has it
    # (n,): variance of each coordinate of the difference of both positions, by all stated standard
    # deviations, at least (1 cm)² [m²]
    variance_m2: FloatArray
    # (n, 3, 3): north, east, down at the vehicle in the ENU frame, as columns; kept for all times
    # that are tried
    frame_from_ned: FloatArray

    @classmethod
    def of(
        cls,
        sightings: Sequence[Sighting],
        target_positions: TargetPositions,
        poses: ReferencePoses,
        camera: Camera,
        motions: CameraMotions | None = None,
    ) -> Encounters | None:
        """Collect the frames, a selection if there are many; None if there are too few.

        Parameters
        ----------
        motions : CameraMotions, optional
            For a rolling shutter: motion of the camera at each reference pose.
        """
        vehicle = target_positions.vehicle
        rows = {frame: row for row, frame in enumerate(poses.frames)}
        posed = [
            (row_s, sighting, sighting.pose, rows[sighting.frame])
            for sighting in unmistakable(sightings)
            if sighting.pose is not None
            and sighting.target not in target_positions.static
            and sighting.frame in rows
            and (row_s := sighting.row_time_s(camera)) is not None
        ]
        if vehicle is None or len(posed) < MIN_ENCOUNTERS:
            return None
        posed.sort(key=lambda row: (row[0], row[1].frame))
        posed = [posed[index] for index in _thinned(len(posed))]
        row_times_s, used, plate_poses, rows_of_poses = zip(*posed, strict=True)
        row = [*rows_of_poses]
        orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
        opk_deg = poses.opk_deg[row]
        if motions is not None:
            delays_s = np.array([sighting.delay_s(camera) for sighting in used])
            orientations, row = motions.after(orientations, row, delays_s), [*range(len(used))]
        enu_from_camera = orientations.enu_from_camera[row]
        in_camera_m = np.array([pose.translation_m for pose in plate_poses])
        sight_m = np.einsum("nij,nj->ni", enu_from_camera, in_camera_m)
        by_poses_m2 = orientations.place_covariances(row, sight_m)
        time_s = np.array(row_times_s) + vehicle.settings.time_offset_s
        draft = cls(
            vehicle=vehicle,
            camera=camera,
            time_s=time_s,
            position_m=np.empty((0, 3)),
            attitude_deg=np.empty((0, 3)),
            lever_arm_m=np.array(vehicle.settings.lever_arm_m),
            pixel=np.array([sighting.centre_px for sighting in used]),
            in_camera_m=in_camera_m,
            camera_from_plate=np.array([pose.rotation for pose in plate_poses]),
            centre_m=orientations.centre_m[row],
            enu_from_camera=enu_from_camera,
            opk_deg=opk_deg,
            variance_m2=_variance_m2(used, vehicle, by_poses_m2, time_s),
            frame_from_ned=np.broadcast_to(ENU_FROM_NED, (len(row), 3, 3)),
        )
        place = draft.at(time_s).position_m
        place[~np.isfinite(place).all(axis=1)] = vehicle.motion.position_m[0]
        level = target_positions.local_frame.level_rotations(place)
        return replace(draft, frame_from_ned=level @ ENU_FROM_NED).at(time_s)

    def at(self, time_s: FloatArray) -> Encounters:
        """Return the encounters with the vehicle's states at other times (n,) [s]."""
        position, body = _states(self.vehicle.motion, time_s)
        attitude = roll_pitch_heading_deg(np.swapaxes(self.frame_from_ned, 1, 2) @ body)
        return replace(self, time_s=time_s, position_m=position, attitude_deg=attitude)

    def is_covered(self, time_s: FloatArray) -> bool:
        """Tell whether enough of other times (n,) lie between the trajectory's ends."""
        first, last = self.vehicle.motion.time_s[[0, -1]]
        return bool(np.mean((time_s >= first) & (time_s <= last)) >= _MIN_COVERED_SHARE)

    @property
    def frame_from_body(self) -> FloatArray:
        """Body axes in the ENU frame (n, 3, 3), as columns."""
        axes: FloatArray = self.frame_from_ned @ body_to_ned(*self.attitude_deg.T)
        return axes

    def with_camera_of(self, other: Encounters) -> Encounters:
        """Return these encounters with camera and reference of others."""
        return replace(
            self,
            camera=other.camera,
            in_camera_m=other.in_camera_m,
            centre_m=other.centre_m,
            enu_from_camera=other.enu_from_camera,
        )

    @property
    def by_vehicle_m(self) -> FloatArray:
        """Position of the target by the vehicle (n, 3), in the ENU frame [m]."""
        return np.asarray(self.position_m + self.frame_from_body @ self.lever_arm_m)

    @property
    def by_camera_m(self) -> FloatArray:
        """Position of the target by camera and reference (n, 3), in the ENU frame [m]."""
        sight = np.einsum("nij,nj->ni", self.enu_from_camera, self.in_camera_m)
        return np.asarray(self.centre_m + sight)

    @property
    def offset_m(self) -> FloatArray:
        """Position by the vehicle minus position by the camera (n, 3), in the ENU frame [m]."""
        return np.asarray(self.by_vehicle_m - self.by_camera_m)

    @property
    def misfit(self) -> float:
        """Median of the offsets' χ², normalised to 1 if their variances are right."""
        return misfit_of(self.offset_m, self.variance_m2)

    @property
    def apart_m(self) -> float:
        """Median length of the offsets [m]."""
        length = np.linalg.norm(self.offset_m, axis=1)
        return float(np.nanmedian(length)) if np.isfinite(length).any() else np.inf


def _thinned(count: int) -> list[int]:
    """Return which of many encounters to use: runs of neighbours, evenly spaced."""
    if count <= _MAX_ENCOUNTERS:
        return [*range(count)]
    starts = np.linspace(0, count - _RUN, _MAX_ENCOUNTERS // _RUN).astype(int)
    return (starts[:, None] + np.arange(_RUN)).ravel().tolist()


def misfit_of(offset_m: FloatArray, variance_m2: FloatArray) -> float:
    """Return the misfit of offsets (n, 3); infinite if too few are known."""
    square = np.sum(offset_m**2, axis=1) / variance_m2
    known = np.isfinite(square)
    if np.count_nonzero(known) < max(MIN_ENCOUNTERS, _MIN_COVERED_SHARE * len(square)):
        return np.inf
    return float(np.median(square[known])) / _MEDIAN_CHI2


def _variance_m2(
    sightings: Sequence[Sighting],
    vehicle: Vehicle,
    by_poses_m2: FloatArray,
    time_s: FloatArray,
) -> FloatArray:
    """Return variances (n,) [m²], as if each error were the same in all directions.

    `by_poses_m2` (n, 3, 3) are the covariances of the targets' places by the reference poses.
    """
    settings, motion = vehicle.settings, vehicle.motion
    total = np.full(len(sightings), _MIN_SD_M**2)
    for sds in (
        [sighting.sd_distance_m or 0.0 for sighting in sightings],
        [sighting.sd_common_distance_m or 0.0 for sighting in sightings],
    ):
        total += np.square(sds)
    total += max(settings.sd_lever_arm_m) ** 2
    if motion.sd_position_m is not None:
        worst_m = motion.sd_position_m.max(axis=1)
        total += np.interp(time_s, motion.time_s, worst_m) ** 2  # large while GNSS is out
    total += np.diagonal(by_poses_m2, axis1=1, axis2=2).max(axis=1)
    way = np.linalg.norm(np.diff(motion.position_m, axis=0), axis=1).sum()
    speed = float(way) / float(motion.time_s[-1] - motion.time_s[0])
    return total + (settings.sd_time_s * speed) ** 2


def _states(motion: Motion, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3) and body axes (n, 3, 3) at times (n,); NaN where not covered.

    Positions follow a cubic through the four nearest samples. Slips are tried at many times, and
    splines through a whole trajectory would take seconds for each.
    """
    time_s = np.nan_to_num(time_s, nan=motion.time_s[0] - 1.0)  # unknown times are not covered
    left = np.clip(np.searchsorted(motion.time_s, time_s, side="right") - 1, 0, None)
    left = np.clip(left, 0, len(motion.time_s) - 2)
    position = _cubic(motion, left, time_s)
    step = motion.time_s[left + 1] - motion.time_s[left]
    share = np.clip((time_s - motion.time_s[left]) / step, 0.0, 1.0)
    start = Rotation.from_matrix(motion.frame_from_body[left])
    end = Rotation.from_matrix(motion.frame_from_body[left + 1])
    turn = (end * start.inv()).as_rotvec()
    body = (Rotation.from_rotvec(share[:, None] * turn) * start).as_matrix()
    outside = (time_s < motion.time_s[0]) | (time_s > motion.time_s[-1])
    outside |= step > _MAX_GAP_INTERVALS * _usual_step(motion)
    position[outside] = np.nan
    return position, body


def _usual_step(motion: Motion) -> float:
    few = motion.time_s[:: max(1, len(motion.time_s) // 1000)]
    return float(np.median(np.diff(few))) / max(1, len(motion.time_s) // 1000)


def _cubic(motion: Motion, left: IndexArray, time_s: FloatArray) -> FloatArray:
    """Return Lagrange interpolations (n, 3) through the four samples around each time (n,)."""
    count = min(4, len(motion.time_s))
    first = np.clip(left - 1, 0, len(motion.time_s) - count)
    nodes = first[:, None] + np.arange(count)
    at = motion.time_s[nodes] - time_s[:, None]
    weights = np.ones_like(at)
    for row in range(count):
        for other in range(count):
            if other != row:
                weights[:, row] *= -at[:, other] / (at[:, row] - at[:, other])
    return np.asarray(np.einsum("nk,nki->ni", weights, motion.position_m[nodes]))
