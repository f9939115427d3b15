"""Checks of reference poses against the vehicle, before anything is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.target_positions import TargetPositions, Vehicle
from kgcp.quality.checks.doubt import Cause, Doubt, grave

# Largest distance from the vehicle to the nearest camera, more than the height of survey aircraft.
_MAX_DISTANCE_M = 6000.0
_MAX_EPOCHS = 1000  # from which a trajectory's height is computed


def check_reference(poses: ReferencePoses, target_positions: TargetPositions) -> Iterator[Doubt]:
    """Yield the doubt about reference poses far from the vehicle, or below it."""
    vehicle = target_positions.vehicle
    if vehicle is None or not len(poses.frames):
        return
    ground = vehicle.motion.position_m
    off_m = _distance(poses.position_map, vehicle, ground)
    if off_m > _MAX_DISTANCE_M:
        yield _far(poses, vehicle, ground, off_m)
        return
    frame = vehicle.local_frame
    cameras = frame.geodetic_deg(frame.enu_from_map(poses.position_map))
    road = frame.geodetic_deg(ground[:: max(1, len(ground) // _MAX_EPOCHS)])
    above_m = float(np.median(cameras[:, 2]) - np.median(road[:, 2]))
    if above_m < 0.0:
        yield grave(
            Cause.HEIGHTS,
            f"the reference poses put the camera {-above_m:.1f} m below the vehicle (medians)",
            "give both in heights of one kind: ellipsoidal ones, or a compound crs that names"
            " the geoid; [reference] crs and [vehicle] crs may differ",
            {"camera_above_vehicle_m": above_m},
        )


def check_visibility(
    posed: Sequence[str], frames: Sequence[str], expected_radii_px: FloatArray | None
) -> Iterator[Doubt]:
    """Yield the doubt about poses that belong to no frame, or that show the target in none.

    Parameters
    ----------
    posed : sequence of str
        Names of the frames that have a pose.
    expected_radii_px : (n,) array or None
        Radii of the target in the frames that should show it; None: not known.
    """
    if posed and not set(posed) & set(frames):
        yield grave(
            Cause.REFERENCE,
            f"no reference pose has the name of a frame: a pose is named {posed[0]!r}, a frame"
            f" {frames[0]!r}",
            "give the poses the names of the frames, relative to the frames folder",
        )
    elif expected_radii_px is not None and not len(expected_radii_px):
        yield grave(
            Cause.REFERENCE,
            "according to reference poses and trajectory, the target is in no frame",
            "check unit, order and signs of omega, phi, kappa, and the times of the frames",
        )


def _far(poses: ReferencePoses, vehicle: Vehicle, ground: FloatArray, off_m: float) -> Doubt:
    """Return the doubt about distant poses, with the first slip that explains the distance."""
    figures = {"distance_m": off_m}
    sentence = f"reference poses and trajectory are at least {off_m / 1000.0:.4g} km apart"
    # if both positions exist on Earth, one cannot tell in which file the axes are exchanged
    swapped_poses = poses.position_map[:, [1, 0, 2]]
    if _distance(swapped_poses, vehicle, ground) < _MAX_DISTANCE_M or _fits_swapped(
        poses, vehicle, ground
    ):
        return grave(
            Cause.AXES_SWAPPED,
            f"{sentence}: they fit if x and y of the reference poses, or those of the trajectory,"
            " are exchanged",
            "find out which of the two is in the wrong place, and put its easting (or longitude)"
            " into x and its northing (or latitude) into y",
            figures,
        )
    for words, convert in _UNITS:
        if _distance(convert(poses.position_map), vehicle, ground) < _MAX_DISTANCE_M:
            return grave(
                Cause.ANGLE_UNIT,
                f"{sentence}: they fit if longitude and latitude of the poses are {words}",
                "give longitude and latitude in degrees",
                figures,
            )
    return grave(
        Cause.REFERENCE,
        sentence,
        "give [reference] crs if the poses are not in the flight's crs, and check zones and"
        " hemispheres",
        figures,
    )


def _fits_swapped(poses: ReferencePoses, vehicle: Vehicle, ground: FloatArray) -> bool:
    """Tell whether the poses are near the trajectory after exchanging x and y of the latter."""
    on_map = vehicle.local_frame.map_from_enu(ground[:1])[:, [1, 0, 2]]
    try:
        moved = vehicle.local_frame.enu_from_map(on_map)
    except KgcpError:
        return False
    return _distance(poses.position_map, vehicle, moved) < _MAX_DISTANCE_M


_UNITS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("in radians", lambda xyz: np.column_stack((np.degrees(xyz[:, :2]), xyz[:, 2]))),
)


def _distance(position_map: FloatArray, vehicle: Vehicle, ground: FloatArray) -> float:
    """Return how far the nearest position is from the bounding box of the trajectory [m]."""
    try:
        cameras = vehicle.local_frame.enu_from_map(position_map)
    except KgcpError:
        return np.inf
    low, high = ground.min(axis=0), ground.max(axis=0)
    beyond = np.maximum(np.maximum(low - cameras, cameras - high), 0.0)
    return float(np.linalg.norm(beyond, axis=1).min())
