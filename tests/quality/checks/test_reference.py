from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.reference import check_reference, check_visibility
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

PLACE = np.array([11.549, 48.151, 545.0])
TARGET = Target(Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0)))


def vehicle(place: FloatArray) -> TargetPositions:
    time_s = np.arange(100.0)
    position = np.tile(place, (100, 1))
    position[:, 0] += 1e-5 * time_s
    trajectory = Trajectory(time_s, position, np.zeros((100, 3)), None, None)
    return TargetPositions.of("EPSG:4326", [TARGET], trajectory, VehicleSettings())


def poses(place: FloatArray, height_m: float = 60.0) -> ReferencePoses:
    positions = np.tile(place, (5, 1)) + np.array([0.0, 0.0, height_m])
    names = tuple(f"{index}.jpg" for index in range(5))
    return ReferencePoses(names, positions, np.zeros((5, 3)), None, None)


def test_cameras_above_the_vehicle_raise_no_doubt() -> None:
    assert not [*check_reference(poses(PLACE), vehicle(PLACE))]
    block = poses(PLACE)
    far = block.position_map + [[0.3 * row, 0.2 * row, 0.0] for row in range(5)]
    assert not [*check_reference(replace(block, position_map=far), vehicle(PLACE))]


@pytest.mark.parametrize(
    ("camera", "ground", "code", "words"),
    [
        (
            PLACE[[1, 0, 2]],
            PLACE,
            Cause.AXES_SWAPPED,
            "poses, or those of the trajectory, are exch",
        ),
        (
            PLACE,
            PLACE[[1, 0, 2]],
            Cause.AXES_SWAPPED,
            "poses, or those of the trajectory, are exch",
        ),
        (np.radians(PLACE), PLACE, Cause.ANGLE_UNIT, "of the poses are in radians"),
        (PLACE + np.array([1.0, 0.0, 0.0]), PLACE, Cause.REFERENCE, "74.34 km apart"),
        (PLACE - np.array([0.0, 0.0, 100.0]), PLACE, Cause.HEIGHTS, "40.0 m below the vehicle"),
    ],
)
def test_cameras_far_from_the_vehicle_are_reported(
    camera: FloatArray, ground: FloatArray, code: Cause, words: str
) -> None:
    place = camera if camera[2] > 400.0 else np.array([*camera[:2], 545.0])
    if code is Cause.HEIGHTS:
        place = camera
    (doubt,) = check_reference(poses(place), vehicle(ground))
    assert doubt.code is code
    assert words in doubt.sentence


def test_poses_of_other_frames_or_that_see_no_target_are_reported() -> None:
    names = poses(PLACE).frames
    assert not [*check_visibility(names, names, np.array([20.0]))]
    assert not [*check_visibility(names, names, None)]
    (doubt,) = check_visibility(names, ["DJI_0.jpg"], None)
    assert "'0.jpg', a frame 'DJI_0.jpg'" in doubt.sentence
    (doubt,) = check_visibility(names, names, np.array([]))
    assert "the target is in no frame" in doubt.sentence
