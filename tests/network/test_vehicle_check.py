"""A target on a vehicle among static ones, where a trajectory puts it or not."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import FramePose
from kgcp.network.ground.point_images import CameraPose
from kgcp.network.ground.vehicle_check import VehicleOff, vehicle_off
from tests.ground_flight import CAMERA, GroundFlight

_SD_TURN_RAD = 0.003  # of poses; at 28 m, it displaces cameras by 8 cm


def compared(offsets_m: FloatArray, sd_scale: float = 0.005) -> VehicleOff | None:
    """The result if the trajectory is off by these amounts (n, 3) in n frames."""
    flight = GroundFlight(frames=len(offsets_m))
    rng = np.random.default_rng(1)
    poses, on_vehicle = [], {}
    for row, frame in enumerate(flight.frame_names):
        plate, cov = flight.measured(row, 3)
        sight = cross_matrix(flight.positions[3] - flight.centres[row])
        # cameras that are turned about the targets: shift and rotation nearly cancel
        turn = _SD_TURN_RAD * rng.standard_normal(3)
        pose = CameraPose(flight.centres[row], flight.rotations[row])
        pose = pose.moved(np.concatenate((sight @ turn, turn)))
        by_turn = np.vstack((sight, np.eye(3)))
        pose_cov = _SD_TURN_RAD**2 * by_turn @ by_turn.T + np.diag([1e-4] * 3 + [1e-10] * 3)
        poses.append(FramePose(frame, (), pose, pose_cov, (), "", residuals=np.zeros((0, 3))))
        sighting = Sighting(
            frame=frame,
            number=row + 1,
            target="D",
            instance=0,
            time_s=None,
            centre_px=CAMERA.project(plate.translation_m[None])[0],
            centre_cov_px2=None,
            distance_m=plate.distance_m,
            sd_distance_m=None,
            sd_common_distance_m=None,
            pose=plate,
            pose_cov=cov,
        )
        place = flight.positions[3] - offsets_m[row]
        on_vehicle[frame] = sighting, TargetPosition(place, 1e-4 * np.eye(3))
    return vehicle_off(poses, on_vehicle, CAMERA, sd_scale)


def test_a_correct_trajectory_is_not_doubted() -> None:
    assert compared(np.zeros((10, 3))) is None


def test_a_trajectory_to_one_side_is_found_with_poses_that_are_worse() -> None:
    found = compared(np.tile([0.1, -0.06, 0.0], (10, 1)))
    assert found is not None
    assert (found.target, found.compared) == ("D", 10)
    assert found.beside_m == pytest.approx(0.117, abs=0.02)


def test_a_wrong_clock_on_a_road_there_and_back_is_found() -> None:
    """The offsets cancel in the mean."""
    found = compared(np.array([[0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]] * 5))
    assert found is not None
    assert found.beside_m == pytest.approx(0.15, abs=0.02)


@pytest.mark.parametrize(("sd_scale", "is_found"), [(0.005, False), (0.0005, True)])
def test_heights_are_as_certain_as_the_diameters(sd_scale: float, *, is_found: bool) -> None:
    """Without an accuracy of the diameters, a height off by 0.17 m is nothing special."""
    found = compared(np.tile([0.0, 0.0, 0.17], (10, 1)), sd_scale)
    assert (found is not None) == is_found
