"""Prior knowledge of each frame from a flight's data: normals of plates and the camera's motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.plate_priors import CameraAttitudes, normal_priors
from kgcp.georef.scene_rotation import (
    CameraMotions,
    camera_motions,
    more_certain,
    rotations_between_frames,
    rotations_by_places,
)
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, Vehicle
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.measurement.plate_prior import NormalPrior, PlatePrior, SceneRotation
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget

Priors = Mapping[str, PlatePrior]


def priors_of_frames(flight: Flight, data: FlightData, frames: Sequence[str]) -> list[Priors]:
    """Return for each frame the priors of its targets, by their names.

    Detection needs neither reference poses nor a trajectory. If their files cannot be used, there
    are no priors; commands that need the files report the error.

    Raises
    ------
    KgcpError
        If flight.toml says that the plate is level and the reference poses cannot be read, or as
        `FlightData.frame_times`.
    """
    times = data.frame_times.time_s
    time_s = [times.get(frame) for frame in frames]
    moving = [target for target in flight.targets if target.position_m is None]
    normals = _normals(flight, data, frames, time_s, moving)
    by_target = {target.name: normals for target in moving}
    rotations = {
        target.name: _rotations(flight, data, frames, time_s, target)
        for target in flight.all_targets
    }
    unknown: list[NormalPrior | None] = [None] * len(frames)
    priors: list[Priors] = []
    for row in range(len(frames)):
        in_frame = {
            target.name: PlatePrior(
                by_target.get(target.name, unknown)[row], rotations[target.name].get(row)
            )
            for target in flight.all_targets
        }
        priors.append({name: prior for name, prior in in_frame.items() if prior != PlatePrior()})
    return priors


def _normals(
    flight: Flight,
    data: FlightData,
    frames: Sequence[str],
    time_s: Sequence[float | None],
    moving: Sequence[Target],
) -> list[NormalPrior | None]:
    if not moving or flight.vehicle is None:
        return [None] * len(frames)
    level_sd_deg = flight.vehicle.settings.level_sd_deg
    try:
        poses = data.reference_poses if data.has_reference else None
    except KgcpError:
        if level_sd_deg is not None:
            raise
        return [None] * len(frames)
    vehicle: Vehicle | None = None
    if poses is not None and data.has_position_of(moving[0]):
        with suppress(KgcpError):  # a level plate needs no trajectory
            vehicle = data.target_positions.vehicle
    attitudes = CameraAttitudes(poses, flight.plumb_sd_deg)
    return normal_priors(frames, time_s, attitudes, vehicle, level_sd_deg)


def _rotations(
    flight: Flight,
    data: FlightData,
    frames: Sequence[str],
    time_s: Sequence[float | None],
    target: AnyTarget,
) -> dict[int, SceneRotation]:
    """Return by row the rotation of the scene about a target while the frame is read out.

    Poses and times of the frames around show all of it but vibration. The camera's rates in the
    times file are those of the camera alone: what its flight and the target's motion add follows
    from poses and times, or is unknown.
    """
    unknown, rates = SceneRotation.unknown(flight.camera), data.scene_rotations
    around = _rotations_around(flight, data, frames, time_s, target)
    rotations = {row: total for row, (total, _) in around.items()}
    for row, frame in enumerate(frames):
        if frame in rates:
            total, by_places = around.get(row, (None, unknown))
            x, y, z = np.add(rates[frame].velocity_rad_s, by_places.velocity_rad_s).tolist()
            sd_rad_s = math.hypot(rates[frame].sd_rad_s, by_places.sd_rad_s)
            rotations[row] = more_certain(SceneRotation((x, y, z), sd_rad_s), total)
    return rotations


def _rotations_around(
    flight: Flight,
    data: FlightData,
    frames: Sequence[str],
    time_s: Sequence[float | None],
    target: AnyTarget,
) -> dict[int, tuple[SceneRotation, SceneRotation]]:
    """Return by row the scene's rotation by the frames around, and its part by the places."""
    camera = flight.camera
    if not camera.readout_s or not data.has_reference or not data.has_position_of(target):
        return {}
    try:
        poses, target_positions = data.reference_poses, data.target_positions
        posed = {frame: row for row, frame in enumerate(poses.frames)}
        timed = [
            (time, row)
            for row, (frame, time) in enumerate(zip(frames, time_s, strict=True))
            if time is not None and frame in posed
        ]
        timed = sorted(dict(sorted(timed)).items())  # one frame per time
        positions = target_positions.positions(
            [target.name] * len(timed), [time for time, _ in timed]
        )
    except KgcpError:
        return {}
    orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
    placed = [
        (time, row, position)
        for (time, row), position in zip(timed, positions, strict=True)
        if isinstance(position, TargetPosition)
    ]
    if not placed:
        return {}
    at = [posed[frames[row]] for _, row, _ in placed]
    enu_from_camera = orientations.enu_from_camera[at]
    camera_from_enu = np.swapaxes(enu_from_camera, 1, 2)
    sight_m = np.array([position.position_m for *_, position in placed]) - orientations.centre_m[at]
    enu_from_body = np.array(
        [
            np.eye(3) if position.vehicle_state is None else position.vehicle_state.frame_from_body
            for *_, position in placed
        ]
    )
    placed_s, unknown = np.array([time for time, *_ in placed]), SceneRotation.unknown(camera)
    rotations = rotations_between_frames(
        placed_s,
        np.einsum("nij,nj->ni", camera_from_enu, sight_m),
        camera_from_enu @ enu_from_body,
        unknown,
    )
    by_places = rotations_by_places(placed_s, sight_m, enu_from_camera, enu_from_body, unknown)
    pairs = zip(rotations, by_places, strict=True)
    return {row: pair for (_, row, _), pair in zip(placed, pairs, strict=True)}


def motions_while_read(
    flight: Flight,
    data: FlightData,
    poses: ReferencePoses,
    local_frame: LocalFrame,
    time_s: Mapping[str, float],
    sightings: Sequence[Sighting],
) -> CameraMotions | None:
    """Return the motion of the camera while frames are read out, in the order of their poses.

    None: there is no rolling shutter, or nothing was measured.

    Parameters
    ----------
    time_s : mapping
        Times of frames [s]: those of the detections.
    """
    if not flight.camera.readout_s or not sightings:
        return None
    orientations = ExteriorOrientations.of(poses, local_frame)
    rates = data.scene_rotations
    return camera_motions(
        np.array([time_s.get(frame, math.nan) for frame in poses.frames]),
        orientations.centre_m,
        orientations.enu_from_camera,
        [rates.get(frame) for frame in poses.frames],
        SceneRotation.unknown(flight.camera),
        float(np.median([sighting.distance_m for sighting in sightings])),
    )
