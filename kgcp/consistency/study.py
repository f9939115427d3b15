"""The target's places by its vehicle against those by the camera's reference poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from kgcp.carrier import Place, Ride, Whereabouts
from kgcp.consistency.corrections import BoolArray, Estimate, estimate, find_outliers
from kgcp.consistency.whitening import whiten
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.geometry.reference import ReferencePoses
from kgcp.target.sighting import Sighting
from kgcp.views import Views

MIN_POINTS = 10
_MODEL_SD_M = 0.001  # interpolation and rounding; keeps covariances regular
_STANDING_M_S = 0.2  # below, the track is where the vehicle points
_NEIGHBOUR_S = 5.0  # over which a camera's velocity shows in its positions


@dataclass(frozen=True, slots=True, eq=False)
class Discrepancy:
    """Between the two places of a target in one frame.

    Attributes
    ----------
    frame, target : str
        As in the sighting.
    time_s : float
        When the target's row was exposed, by the trajectory's clock, Unix UTC [s].
    offset_m : (3,) array
        By the vehicle minus by the camera: along the track, across it to the right, up [m].
    cov_m2 : (3, 3) array
        Covariance by all stated deviations but those that all frames share [m²].
    residual_m : (3,) array
        What the corrections leave of the offset [m].
    is_outlier : bool
        Whether it fits no correction and had no part in them.
    """

    frame: str
    target: str
    time_s: float
    offset_m: FloatArray
    cov_m2: FloatArray
    residual_m: FloatArray
    is_outlier: bool


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """How well vehicle and camera agree.

    Attributes
    ----------
    discrepancies : tuple of Discrepancy
        Ascending in time.
    estimate : Estimate
        Corrections that explain them.
    """

    discrepancies: tuple[Discrepancy, ...]
    estimate: Estimate


@dataclass(frozen=True, slots=True, eq=False)
class _Meeting:
    """One frame with both places: sighting, its time, pose and covariance, and its ride."""

    seen: Sighting
    pose: Pose
    time_s: float
    place: Place
    ride: Ride
    row: int


def study_consistency(
    sightings: Sequence[Sighting],
    whereabouts: Whereabouts,
    poses: ReferencePoses,
    camera: Camera,
) -> Consistency | None:
    """Compare the places of the target on the vehicle with those that the camera gives it.

    By the vehicle: trajectory and lever arm. By the camera: reference pose and measured pose of
    the target, P = C + R(ENU ← camera) t, where a rolling shutter's camera has moved on, too.

    Parameters
    ----------
    sightings : sequence of Sighting
        Without a pose or a reference pose they are passed over, and so are static targets.
    whereabouts : Whereabouts
        Of the flight's targets.
    poses : ReferencePoses
    camera : Camera
        For the rolling shutter.

    Returns
    -------
    Consistency or None
        None with fewer than ten frames to compare.

    Raises
    ------
    KgcpError
        As `Whereabouts.places`.
    """
    meetings = _meet(sightings, whereabouts, poses, camera)
    if len(meetings) < MIN_POINTS or whereabouts.carrier is None:
        return None
    views = Views.of(poses, whereabouts.frame)
    system = _System.of(meetings, views, poses, camera, whereabouts.carrier.settings.sd_time_s)
    outlier = find_outliers(system.design, system.offset, system.fading + system.white)
    columns = np.concatenate(
        (system.design, system.offset[:, :, None], system.common[:, :, None]), axis=2
    )
    kept = ~outlier
    whitened = whiten(
        np.array([one.time_s for one in meetings])[kept],
        system.fading[kept],
        system.white[kept],
        whereabouts.carrier.settings.correlation_s,
        columns[kept],
    )
    found = estimate(whitened.reshape(-1, columns.shape[2]), has_deviations=system.has_deviations)
    offset_s = whereabouts.carrier.settings.time_offset_s
    return Consistency(_discrepancies(meetings, system, outlier, found, offset_s), found)


def _meet(
    sightings: Sequence[Sighting],
    whereabouts: Whereabouts,
    poses: ReferencePoses,
    camera: Camera,
) -> list[_Meeting]:
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    moving = [
        seen
        for seen in sightings
        if not seen.instance and seen.target not in whereabouts.static and seen.frame in rows
    ]
    if not moving:
        return []
    times = [seen.row_time_s(camera) for seen in moving]
    places = whereabouts.places([seen.target for seen in moving], times)
    meetings = [
        _Meeting(seen, seen.pose, time_s, place, place.ride, rows[seen.frame])
        for seen, time_s, place in zip(moving, times, places, strict=True)
        if isinstance(place, Place) and place.ride and seen.pose and time_s is not None
    ]
    return sorted(meetings, key=lambda one: (one.time_s, one.seen.frame))


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Discrepancies (n, 3) in ENU axes, what moves them (n, 3, 8), and their covariances.

    `fading` is the share of the trajectory, `white` that of all that is independent from frame to
    frame; `common` (n, 3) is one deviation of the distances by calibration and diameter.
    """

    offset: FloatArray
    design: FloatArray
    fading: FloatArray
    white: FloatArray
    common: FloatArray
    has_deviations: bool
    track: FloatArray

    @classmethod
    def of(
        cls,
        meetings: Sequence[_Meeting],
        views: Views,
        poses: ReferencePoses,
        camera: Camera,
        sd_time_s: float,
    ) -> _System:
        rows = [one.row for one in meetings]
        attitude = views.enu_from_camera[rows]
        in_camera = np.array([one.pose.translation_m for one in meetings])
        sight = np.einsum("nij,nj->ni", attitude, in_camera)
        velocity = np.array([one.ride.velocity_m_s for one in meetings])
        body = np.array([one.ride.frame_from_body for one in meetings])
        since_middle = np.array([one.seen.rows_since_middle(camera) for one in meetings])[:, None]
        moved = _camera_velocity(meetings, views.centre_m[rows], velocity)
        centre = views.centre_m[rows] + moved * since_middle * camera.readout_s
        offset = np.array([one.place.position_m for one in meetings]) - centre - sight
        columns = (velocity[:, :, None], body, (since_middle * (velocity - moved))[:, :, None])
        design = np.concatenate((*columns, attitude @ _cross(in_camera)), axis=2)
        fading = np.array([_fading_m2(one.place) for one in meetings])
        white = _white_m2(meetings, views, poses, sight)
        shift = sd_time_s * velocity
        white = white + shift[:, :, None] * shift[:, None, :]
        common_m = np.array([one.seen.sd_common_distance_m or 0.0 for one in meetings])
        unit = sight / np.linalg.norm(sight, axis=1, keepdims=True)
        stated = all(one.place.cov_m2 is not None for one in meetings) and views.cov_m2 is not None
        return cls(
            offset, design, fading, white, unit * common_m[:, None], stated, _track(velocity, body)
        )


def _fading_m2(place: Place) -> FloatArray:
    if place.cov_m2 is None or place.common_m is None:
        return np.zeros((3, 3))
    return place.cov_m2 - place.common_m @ place.common_m.T


def _white_m2(
    meetings: Sequence[_Meeting], views: Views, poses: ReferencePoses, sight: FloatArray
) -> FloatArray:
    """Return the covariance (n, 3, 3) of reference poses and measured poses, in ENU axes."""
    rows = [one.row for one in meetings]
    attitude = views.enu_from_camera[rows]
    total = np.broadcast_to(_MODEL_SD_M**2 * np.eye(3), attitude.shape)
    measured = [one.seen.pose_cov for one in meetings]
    of_pose = np.array([np.zeros((3, 3)) if cov is None else cov[:3, :3] for cov in measured])
    total = total + attitude @ of_pose @ np.swapaxes(attitude, 1, 2)
    if views.cov_m2 is not None:
        total = total + views.cov_m2[rows]
    if poses.sd_angle_deg is not None:
        effect = _cross(sight) * np.radians(poses.sd_angle_deg[rows])[:, None, None]
        total = total + effect @ np.swapaxes(effect, 1, 2)
    return np.asarray(total)


def _camera_velocity(
    meetings: Sequence[_Meeting], centre: FloatArray, otherwise: FloatArray
) -> FloatArray:
    """Return the camera's velocity (n, 3) by splines through its positions, not across gaps.

    Where there is nothing to interpolate it is taken to follow the vehicle.
    """
    time_s = np.array([one.time_s for one in meetings])
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
    none, one = np.zeros_like(east), np.ones_like(east)
    rows = ((east, north, none), (north, -east, none), (none, none, one))
    return np.moveaxis(np.array(rows), 2, 0)


def _cross(vectors: FloatArray) -> FloatArray:
    """Return the matrices [v]× (n, 3, 3) of vectors (n, 3)."""
    return np.asarray(np.cross(vectors[:, None, :], np.eye(3)[None], axis=2).swapaxes(1, 2))


def _discrepancies(
    meetings: Sequence[_Meeting],
    system: _System,
    outlier: BoolArray,
    found: Estimate,
    time_offset_s: float,
) -> tuple[Discrepancy, ...]:
    residual = system.offset + system.design @ found.values
    cov = system.track @ (system.fading + system.white) @ np.swapaxes(system.track, 1, 2)
    offset_m = np.einsum("nij,nj->ni", system.track, system.offset)
    residual_m = np.einsum("nij,nj->ni", system.track, residual)
    return tuple(
        Discrepancy(
            one.seen.frame,
            one.seen.target,
            one.time_s + time_offset_s,
            offset_m[index],
            cov[index],
            residual_m[index],
            bool(outlier[index]),
        )
        for index, one in enumerate(meetings)
    )
