"""Frames that show two plates of one code: nothing tells which of them is the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, ReferencePoses, opk_from_rotation
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import orient_frames
from kgcp.network.ground.target_places import Placement, place_targets
from kgcp.targets.layout import Ring, Target
from tests.ground_flight import CAMERA, GroundFlight

SDS = np.array([1e-4, 1e-4, 3e-3, 2e-4, 2e-4, 1e-3])  # of poses [m] and [rad]
TARGET = Target(Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0)))


def sighting(flight: GroundFlight, row: int, column: int, instance: int = 0) -> Sighting:
    pose = flight.pose(row, column)
    return Sighting(
        frame=flight.frame_names[row],
        number=row + 1,
        target=flight.names[column],
        instance=instance,
        time_s=None,
        centre_px=CAMERA.project(pose.translation_m[None])[0],
        centre_cov_px2=1e-4 * np.eye(2),
        distance_m=pose.distance_m,
        sd_distance_m=3e-3,
        sd_common_distance_m=None,
        pose=pose,
        pose_cov=np.diag(SDS**2),
    )


def spare(flight: GroundFlight, row: int) -> list[Sighting]:
    """A spare plate of target A, 2 m beside it, with the better score; A itself is the second."""
    best, second = sighting(flight, row, 0), sighting(flight, row, 0, instance=1)
    assert best.pose is not None
    moved = replace(best.pose, translation_m=best.pose.translation_m + np.array([2.0, 0.0, 0.0]))
    centre_px = CAMERA.project(moved.translation_m[None])[0]
    return [replace(best, pose=moved, centre_px=centre_px), second]


def test_they_are_not_oriented_by_either() -> None:
    flight = GroundFlight(frames=3)
    sightings = [sighting(flight, 0, column) for column in range(4)]
    sightings += [*spare(flight, 1), *(sighting(flight, 1, column) for column in (1, 2, 3))]
    sightings += spare(flight, 2)
    places = {
        name: TargetPosition(place, None)
        for name, place in zip(flight.names, flight.positions, strict=True)
    }
    whole, three, none = orient_frames(flight.frame_names, sightings, places, CAMERA)
    assert whole.used == flight.names
    assert three.used == flight.names[1:]
    assert none.reason == "no static target, besides 1 whose code several plates have"
    for pose, centre_m in zip((whole, three), flight.centres[:2], strict=True):
        assert pose.pose is not None
        np.testing.assert_allclose(pose.pose.centre_m, centre_m, atol=0.05)


def placement_of(flight: GroundFlight, sightings: list[Sighting]) -> Placement:
    on_map = flight.local_frame.map_from_enu(flight.centres)
    to_map = np.swapaxes(flight.local_frame.grid_rotation(flight.centres), 1, 2)
    angles = opk_from_rotation(to_map @ flight.rotations @ CAMERA_FROM_PHOTO)
    poses = ReferencePoses(flight.frame_names, on_map, angles, None, None)
    return place_targets(
        sightings,
        [TARGET],
        poses,
        flight.local_frame,
        CAMERA,
        None,
        min_frames=3,
        has_exact_poses=False,
    )


def test_no_target_is_placed_by_them() -> None:
    flight = GroundFlight(frames=8)
    doubtful = [each for row in range(5) for each in spare(flight, row)]
    certain = [sighting(flight, row, 0) for row in (5, 6, 7)]
    (target,) = placement_of(flight, doubtful + certain).targets
    assert target.frames == flight.frame_names[5:]
    np.testing.assert_allclose(target.position_map, flight.positions_map[0], atol=0.02)
    assert placement_of(flight, doubtful + certain[:2]).skipped == {
        "A": "measured in 2 frames, besides 5 that show several plates with its code, 2 of them"
        " with a reference pose; 3 are needed"
    }
