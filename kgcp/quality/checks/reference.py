"""Reference poses against the vehicle, before anything is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.target_positions import TargetPositions, Vehicle
from kgcp.quality.checks.doubt import Cause, Doubt, grave

_FAR_M = 6000.0  # from the nearest camera to the vehicle, higher than aircraft take photographs
_FEW = 1000  # epochs of a trajectory that tell its height


def check_reference(poses: ReferencePoses, target_positions: TargetPositions) -> Iterator[Doubt]:
    """Tell reference poses far from the vehicle, or below it."""
    vehicle = target_positions.vehicle
    if vehicle is None or not len(poses.frames):
        return
    ground = vehicle.motion.position_m
    off_m = _distance(poses.position_map, vehicle, ground)
    if off_m > _FAR_M:
        yield _far(poses, vehicle, ground, off_m)
        return
    frame = vehicle.local_frame
    cameras = frame.geodetic_deg(frame.enu_from_map(poses.position_map))
    road = frame.geodetic_deg(ground[:: max(1, len(ground) // _FEW)])
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
    """Tell poses that belong to no frame, or that see the target in none.

    Parameters
    ----------
    posed : sequence of str
        Names of the frames that have a pose.
    expected_radii_px : (n,) array or None
        Of the target in the frames that should show it; None: not known.
    """
    if posed and not set(posed) & set(frames):
        yield grave(
            Cause.REFERENCE,
            f"the reference poses name none of the frames: {posed[0]!r}, but the frames are"
            f" named like {frames[0]!r}",
            "name the poses as the frames, relative to the frames folder",
        )
    elif expected_radii_px is not None and not len(expected_radii_px):
        yield grave(
            Cause.REFERENCE,
            "by reference poses and trajectory the target is in no frame",
            "check unit, order and signs of omega, phi, kappa, and the times of the frames",
        )


def _far(poses: ReferencePoses, vehicle: Vehicle, ground: FloatArray, off_m: float) -> Doubt:
    """Return the doubt about poses far away, by the first slip without which they are near."""
    figures = {"distance_m": off_m}
    sentence = f"reference poses and trajectory are {off_m / 1000.0:.4g} km apart at least"
    # either file exchanged looks the same, where both places exist
    swapped_poses = poses.position_map[:, [1, 0, 2]]
    if _distance(swapped_poses, vehicle, ground) < _FAR_M or _fits_swapped(poses, vehicle, ground):
        return grave(
            Cause.AXES_SWAPPED,
            f"{sentence}: with x and y of the reference poses, or else of the trajectory,"
            " exchanged they fit",
            "find out which of the two is elsewhere, and put its easting (or longitude) into x and"
            " its northing into y",
            figures,
        )
    for words, convert in _UNITS:
        if _distance(convert(poses.position_map), vehicle, ground) < _FAR_M:
            return grave(
                Cause.ANGLE_UNIT,
                f"{sentence}: with longitude and latitude of the poses {words} they fit",
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
    """Whether the poses are near the trajectory with x and y of the latter exchanged."""
    on_map = vehicle.local_frame.map_from_enu(ground[:1])[:, [1, 0, 2]]
    try:
        moved = vehicle.local_frame.enu_from_map(on_map)
    except KgcpError:
        return False
    return _distance(poses.position_map, vehicle, moved) < _FAR_M


_UNITS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("in radians", lambda xyz: np.column_stack((np.degrees(xyz[:, :2]), xyz[:, 2]))),
)


def _distance(position_map: FloatArray, vehicle: Vehicle, ground: FloatArray) -> float:
    """Return how far the nearest place is from the box that the vehicle has driven in [m]."""
    try:
        cameras = vehicle.local_frame.enu_from_map(position_map)
    except KgcpError:
        return np.inf
    low, high = ground.min(axis=0), ground.max(axis=0)
    beyond = np.maximum(np.maximum(low - cameras, cameras - high), 0.0)
    return float(np.linalg.norm(beyond, axis=1).min())
