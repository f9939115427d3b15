"""The camera's orientation from a plate on a vehicle: synthetic truth, and scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, rotation_from_opk
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.camera_priors import (
    MIN_AMBIGUITY,
    CameraPrior,
    body_from_plate,
    camera_priors,
    opk_covs,
    opk_deg,
)
from kgcp.georef.gcp import build_gcps
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, TargetPositions, Vehicle
from kgcp.georef.trajectory import Trajectory, body_to_ned
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

_CAMERA = Camera(width=640, height=480, fx=900.0, fy=900.0, cx=320.0, cy=240.0)
_RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
_LEVER = (-0.8, 0.15, -1.95)
_RPY = np.array([3.0, -5.0, 130.0])
_OPK = np.array([4.0, -7.0, 33.0])
_CRS = "EPSG:25831"
_START = np.array([290000.0, 4583523.0, 120.0])  # 2.5° off the meridian: 1.7° of convergence
_SD_POSITION, _SD_RPY_DEG = np.array([0.02, 0.03, 0.05]), np.array([0.1, 0.2, 0.4])
_LOCAL_FRAME = LocalFrame.at(_CRS, _START)
_POSE_COV = np.diag([0.004, 0.003, 0.02, 0.006, 0.008, 0.002]) ** 2


def _settings(**changes: object) -> VehicleSettings:
    base = VehicleSettings(lever_arm_m=_LEVER, mount_deg=25.0)
    return replace(base, **changes)  # type: ignore[arg-type] # keywords of a test


def _whereabouts(settings: VehicleSettings, rpy: FloatArray, offset: FloatArray) -> TargetPositions:
    time_s = np.arange(0.0, 2.01, 0.1)
    position = _START + offset + np.outer(time_s, [7.0, 3.0, 0.0])
    every = np.ones((len(time_s), 1))
    trajectory = Trajectory(
        time_s, position, every * rpy, every * _SD_POSITION, every * _SD_RPY_DEG
    )
    return TargetPositions(_LOCAL_FRAME, {}, Vehicle.on(trajectory, settings, _LOCAL_FRAME))


def _scene(settings: VehicleSettings) -> tuple[FloatArray, FloatArray, Sighting]:
    """The camera's map position and attitude (camera → grid), and the plate as it is seen."""
    local_frame = _LOCAL_FRAME
    target_positions = _whereabouts(settings, _RPY, np.zeros(3))
    position = target_positions.positions(["A"], [1.0])[0]
    assert isinstance(position, TargetPosition)  # the time is inside
    there = target_positions.local_frame.map_from_enu(position.position_m[None])
    plate_map = local_frame.map_from_enu(local_frame.enu_from_map(there))[0]
    camera_map = plate_map + np.array([12.0, -9.0, 61.0])
    plate, camera = local_frame.enu_from_map(np.array([plate_map, camera_map]))
    map_from_camera = rotation_from_opk(_OPK[None])[0] @ CAMERA_FROM_PHOTO
    enu_from_camera = local_frame.grid_rotation(camera) @ map_from_camera
    ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    enu_from_body = local_frame.level_rotations(plate[None])[0] @ ned @ body_to_ned(*_RPY)
    enu_from_plate = enu_from_body @ body_from_plate(settings.mount_deg)
    pose = Pose(enu_from_camera.T @ enu_from_plate, enu_from_camera.T @ (plate - camera))
    seen = Sighting(
        frame="f_0001.png",
        number=1,
        target="A",
        instance=0,
        time_s=1.0,
        centre_px=np.array([100.0, 240.0]),
        centre_cov_px2=None,
        distance_m=pose.distance_m,
        sd_distance_m=None,
        sd_common_distance_m=None,
        pose=pose,
        pose_cov=_POSE_COV,
        ambiguity=30.0,
    )
    return camera_map, map_from_camera, seen


def _priors(seen: Sighting, target_positions: TargetPositions) -> tuple[CameraPrior, ...]:
    gcps, _ = build_gcps([seen], target_positions, _CAMERA)
    return camera_priors(gcps, [seen], target_positions, _LOCAL_FRAME)


def test_the_default_mount_lies_level_with_its_up_forward() -> None:
    plate = body_from_plate(0.0)
    np.testing.assert_array_equal(plate @ [0.0, -1.0, 0.0], [1.0, 0.0, 0.0])  # up is −y
    np.testing.assert_array_equal(plate @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(plate @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])
    turned = body_from_plate(90.0)  # clockwise from above: up to the right
    np.testing.assert_allclose(turned @ [0.0, -1.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("mount_deg", [0.0, 25.0, -140.0])
def test_priors_have_the_true_position_and_attitude(mount_deg: float) -> None:
    settings = _settings(mount_deg=mount_deg)
    camera_map, map_from_camera, seen = _scene(settings)
    (prior,) = _priors(seen, _whereabouts(settings, _RPY, np.zeros(3)))
    np.testing.assert_allclose(prior.position_map, camera_map, atol=1e-6)
    np.testing.assert_allclose(prior.map_from_camera, map_from_camera, atol=1e-7)
    np.testing.assert_allclose(opk_deg([prior])[0], _OPK, atol=1e-5)


def test_another_crs_for_the_points_needs_no_other_vehicle() -> None:
    settings = _settings()
    camera_map, _, seen = _scene(settings)
    target_positions = _whereabouts(settings, _RPY, np.zeros(3))
    gcps, _ = build_gcps([seen], target_positions, _CAMERA)
    degrees = LocalFrame.at("EPSG:4258", np.array([0.5, 41.37, 120.0]))
    grid = _LOCAL_FRAME
    in_degrees = replace(
        gcps[0],
        position_map=degrees.map_from_enu(
            (
                grid.enu_from_map(gcps[0].position_map[None]) @ grid.ecef_from_enu.T
                + grid.origin_ecef_m
                - degrees.origin_ecef_m
            )
            @ degrees.ecef_from_enu
        )[0],
    )
    (prior,) = camera_priors([in_degrees], [seen], target_positions, degrees)
    back = degrees.enu_from_map(prior.position_map[None]) @ degrees.ecef_from_enu.T
    ecef = back + degrees.origin_ecef_m
    expected = grid.enu_from_map(camera_map[None]) @ grid.ecef_from_enu.T + grid.origin_ecef_m
    np.testing.assert_allclose(ecef, expected, atol=1e-5)
    # Grid north lies west of true north by 2.51° · sin(41.37°): κ, counted to the left, grows.
    assert opk_deg([prior])[0, 2] - _OPK[2] == pytest.approx(1.66, abs=0.02)


def test_covariance_is_that_of_the_scatter() -> None:
    settings = _settings(sd_lever_arm_m=(0.01, 0.01, 0.02), level_sd_deg=0.3)
    camera_map, map_from_camera, seen = _scene(_settings())
    (prior,) = _priors(seen, _whereabouts(settings, _RPY, np.zeros(3)))
    assert prior.cov is not None
    rng = np.random.default_rng(5)
    distances = []
    for _ in range(150):
        errors = rng.standard_normal(15)
        lever = tuple(np.array(_LEVER) + errors[:3] * settings.sd_lever_arm_m)
        rpy = _RPY + errors[3:6] * _SD_RPY_DEG
        moved = _whereabouts(replace(settings, lever_arm_m=lever), rpy, errors[6:9] * _SD_POSITION)
        pose = seen.pose
        assert pose is not None
        tilt = Rotation.from_rotvec([*np.radians(0.3) * rng.standard_normal(2), 0.0]).as_matrix()
        mount = body_from_plate(settings.mount_deg)
        crooked = Pose(pose.rotation @ mount.T @ tilt @ mount, pose.translation_m)
        wrong = crooked.moved(np.sqrt(np.diag(_POSE_COV)) * errors[9:])
        (got,) = _priors(replace(seen, pose=wrong), moved)
        turn = Rotation.from_matrix(got.map_from_camera @ map_from_camera.T).as_rotvec()
        error = np.concatenate((got.position_map - camera_map, turn))
        distances.append(error @ np.linalg.solve(prior.cov, error))
    assert 5.1 < np.mean(distances) < 7.0  # χ² of 6: mean 6 ± 0.28


def test_opk_covariance_is_that_of_small_rotations() -> None:
    turn_cov = np.diag([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]) ** 2 * 1e-8
    rotation = rotation_from_opk(_OPK[None])[0] @ CAMERA_FROM_PHOTO
    prior = CameraPrior("f", np.zeros(3), rotation, turn_cov)
    steps = []
    for axis in range(3):
        turn = Rotation.from_rotvec(1e-6 * np.eye(3)[axis]).as_matrix()
        steps.append(
            (opk_deg([CameraPrior("f", np.zeros(3), turn @ rotation, None)])[0] - _OPK) / 1e-6
        )
    jacobian = np.array(steps).T
    expected = jacobian @ turn_cov[3:, 3:] @ jacobian.T
    (cov,) = opk_covs([prior])
    assert cov is not None
    np.testing.assert_allclose(cov[3:, 3:], expected, rtol=1e-4, atol=1e-12)


def test_common_errors_are_part_of_a_prior() -> None:
    settings = _settings()
    _, _, seen = _scene(settings)
    target_positions = _whereabouts(settings, _RPY, np.zeros(3))
    (own,) = _priors(seen, target_positions)
    (both,) = _priors(replace(seen, common_pose_cov=3.0 * _POSE_COV), target_positions)
    (large,) = _priors(replace(seen, pose_cov=4.0 * _POSE_COV), target_positions)
    assert own.cov is not None
    assert both.cov is not None
    assert large.cov is not None
    assert both.cov[0, 0] > own.cov[0, 0]
    np.testing.assert_allclose(both.cov, large.cov)


def test_ambiguous_poses_give_no_prior() -> None:
    settings = _settings()
    _, _, seen = _scene(settings)
    target_positions = _whereabouts(settings, _RPY, np.zeros(3))
    assert _priors(replace(seen, ambiguity=MIN_AMBIGUITY - 0.1), target_positions) == ()
    assert len(_priors(replace(seen, ambiguity=None), target_positions)) == 1
    assert _priors(replace(seen, pose=None), target_positions) == ()


def test_unknown_deviations_make_no_covariance() -> None:
    settings = _settings()
    _, _, seen = _scene(settings)
    target_positions = _whereabouts(settings, _RPY, np.zeros(3))
    (prior,) = _priors(replace(seen, pose_cov=None), target_positions)
    assert prior.cov is None
    assert opk_covs([prior]) == [None]
    assert target_positions.vehicle is not None
    silent = replace(target_positions.vehicle.motion, sd_attitude_deg=None)
    vehicle = Vehicle(silent, settings, target_positions.local_frame)
    (prior,) = _priors(seen, replace(target_positions, vehicle=vehicle))
    assert prior.cov is None


def test_static_targets_orient_no_camera() -> None:
    static = Target(_RING, position_m=tuple(_START), sd_position_m=(0.01, 0.01, 0.01))
    target_positions = TargetPositions.of(_CRS, [static], None, VehicleSettings())
    _, _, seen = _scene(_settings())
    assert _priors(seen, target_positions) == ()
