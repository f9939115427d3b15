from __future__ import annotations

import csv
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO, rotation_from_opk
from kgcp.georef.target_positions import NoPosition, TargetPosition, TargetPositions, Vehicle
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.time_text import parse_time
from kgcp.io.flight.flight import read_flight
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.trajectories import read_trajectory
from kgcp.settings import VehicleSettings
from kgcp.targets.layout import Ring, Target

_FLIGHTS = Path(__file__).resolve().parents[2] / ".." / "shared" / "flights"
_NAMES = ("machine_vision", "exposure_sweep", "consumer", "blurred", "real_ground")

_RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
_CRS = "EPSG:25831"
_ORIGIN = np.array([430606.1, 4583523.0, 120.0])
_CONVERGENCE = math.radians((2.16984 - 3.0) * math.sin(math.radians(41.40025)))
_LEVER = VehicleSettings(lever_arm_m=(-0.8, 0.15, -1.95), sd_lever_arm_m=(0.005, 0.005, 0.005))


def _straight(
    heading_deg: float,
    sd_position_m: FloatArray | None = None,
    sd_attitude_deg: FloatArray | None = None,
) -> Trajectory:
    """10 m/s along the grid's north for 10 s, the body pointing to `heading_deg`."""
    time_s = np.arange(0.0, 10.01, 0.1)
    position = _ORIGIN + np.outer(time_s, [0.0, 10.0, 0.0])
    attitude = np.tile([0.0, 0.0, heading_deg], (len(time_s), 1))
    n = len(time_s)
    return Trajectory(
        time_s,
        position,
        attitude,
        None if sd_position_m is None else np.tile(sd_position_m, (n, 1)),
        None if sd_attitude_deg is None else np.tile(sd_attitude_deg, (n, 1)),
    )


def _only_place(positions: list[TargetPosition | NoPosition]) -> TargetPosition:
    (position,) = positions
    assert isinstance(position, TargetPosition)
    return position


def test_a_lever_arm_turns_with_heading_against_true_north() -> None:
    settings = VehicleSettings(lever_arm_m=(2.0, 0.0, -1.5))
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], _straight(90.0), settings)
    position = _only_place(target_positions.positions(["A"], [5.0]))
    on_map = target_positions.local_frame.map_from_enu(position.position_m[None])[0] - _ORIGIN
    # 2 m to the true east, seen on a grid whose north leans west of true north
    np.testing.assert_allclose(
        on_map - [0.0, 50.0, 1.5],
        [2.0 * 0.9996 * math.cos(_CONVERGENCE), 2.0 * math.sin(_CONVERGENCE), 0.0],
        atol=3e-4,
    )


def test_rolled_and_pitched_lever_arms() -> None:
    time_s = np.array([0.0, 1.0, 2.0])
    still = np.tile(_ORIGIN, (3, 1))
    trajectory = Trajectory(time_s, still, np.tile([90.0, 0.0, 0.0], (3, 1)), None, None)
    settings = VehicleSettings(lever_arm_m=(0.0, 0.0, -2.0))
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], trajectory, settings)
    position = _only_place(target_positions.positions(["A"], [1.0]))
    # rolled right side down by 90 deg: what was 2 m above is now 2 m to the right, the east
    np.testing.assert_allclose(position.position_m, [2.0, 0.0, 0.0], atol=1e-9)
    assert position.cov_m2 is None


def test_covariance_of_a_level_vehicle_adds_up_as_by_hand() -> None:
    settings = VehicleSettings(
        lever_arm_m=(0.0, 0.0, -2.0), sd_lever_arm_m=(0.01, 0.02, 0.03), sd_time_s=0.001
    )
    sd_position, sd_attitude = np.array([0.015, 0.016, 0.03]), np.array([0.5, 0.25, 1.0])
    trajectory = _straight(math.degrees(_CONVERGENCE), sd_position, sd_attitude)  # along the grid
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], trajectory, settings)
    position = _only_place(target_positions.positions(["A"], [5.0]))
    assert position.cov_m2 is not None
    grid = target_positions.local_frame.grid_rotation(position.position_m)
    cov = grid.T @ position.cov_m2 @ grid
    expected = [
        0.015**2 + (2.0 * math.radians(0.5)) ** 2 + 0.02**2,  # across: roll, arm's y
        0.016**2 + (2.0 * math.radians(0.25)) ** 2 + 0.01**2 + 0.01**2,  # along: pitch, x, time
        0.03**2 + 0.03**2,
    ]
    np.testing.assert_allclose(np.diag(cov), expected, rtol=1e-3)


def test_scatter_of_perturbed_trajectories_is_the_reported_covariance() -> None:
    rng = np.random.default_rng(5)
    attitude = np.array([4.0, -6.0, 77.0])
    sd_position, sd_attitude = np.array([0.015, 0.02, 0.03]), np.array([0.3, 0.2, 0.4])
    settings = VehicleSettings(
        lever_arm_m=(-0.8, 0.4, -1.95), sd_lever_arm_m=(0.005, 0.01, 0.02), sd_time_s=0.002
    )
    base = _straight(0.0, sd_position, sd_attitude)
    tilted = Trajectory(
        time_s=base.time_s,
        position_map=base.position_map,
        attitude_deg=np.tile(attitude, (len(base.time_s), 1)),
        sd_position_m=base.sd_position_m,
        sd_attitude_deg=base.sd_attitude_deg,
    )
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], tilted, settings)
    reported = _only_place(target_positions.positions(["A"], [5.0]))
    assert reported.cov_m2 is not None

    def perturbed() -> FloatArray:
        moved = Trajectory(
            base.time_s,
            base.position_map + sd_position * rng.standard_normal(3),
            tilted.attitude_deg + sd_attitude * rng.standard_normal(3),
            None,
            None,
        )
        arm = np.array(settings.lever_arm_m) + settings.sd_lever_arm_m * rng.standard_normal(3)
        wrong = VehicleSettings(lever_arm_m=(arm[0], arm[1], arm[2]))
        there = Vehicle.on(moved, wrong, target_positions.local_frame)
        (position,) = there.positions(np.array([5.0 + settings.sd_time_s * rng.standard_normal()]))
        error: FloatArray = position.position_m - reported.position_m
        return error

    errors = np.array([perturbed() for _ in range(400)])
    whitened = np.linalg.solve(np.linalg.cholesky(reported.cov_m2), errors.T)
    scatter = np.cov(whitened)
    np.testing.assert_allclose(scatter, np.eye(3), atol=5.0 * math.sqrt(2.0 / 400.0))
    assert 0.85 < np.trace(scatter) / 3.0 < 1.15


def test_a_static_target_needs_neither_vehicle_nor_time() -> None:
    target = Target(
        _RING, position_m=(430610.0, 4583523.0, 121.0), sd_position_m=(0.01, 0.02, 0.03)
    )
    target_positions = TargetPositions.of(_CRS, [target], None, VehicleSettings())
    position = _only_place(target_positions.positions(["A"], [None]))
    np.testing.assert_allclose(position.position_m, 0.0, atol=1e-8)  # it is the frame's origin
    assert position.cov_m2 is not None
    grid = target_positions.local_frame.grid_rotation(position.position_m)
    np.testing.assert_allclose(
        np.sqrt(np.diag(grid.T @ position.cov_m2 @ grid)), [0.01, 0.02, 0.03], rtol=1e-9
    )


def test_a_static_target_of_unknown_accuracy_is_not_taken_for_exact() -> None:
    target = Target(_RING, position_m=(430610.0, 4583523.0, 121.0))
    target_positions = TargetPositions.of(_CRS, [target], None, VehicleSettings())
    assert _only_place(target_positions.positions(["A"], [None])).cov_m2 is None


def test_single_frames_outside_the_trajectory_are_named_not_placed() -> None:
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], _straight(0.0), _LEVER)
    positions = target_positions.positions(["A"] * 4, [-1.0, None, 5.0, 11.0])
    assert [position for position in positions if isinstance(position, NoPosition)] == [
        NoPosition.BEFORE_TRAJECTORY,
        NoPosition.NO_TIME,
        NoPosition.AFTER_TRAJECTORY,
    ]


def test_a_time_offset_moves_frames_onto_the_trajectory() -> None:
    shifted = VehicleSettings(time_offset_s=-18.0)
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], _straight(0.0), shifted)
    plain = TargetPositions.of(_CRS, [Target(_RING)], _straight(0.0), VehicleSettings())
    late = _only_place(target_positions.positions(["A"], [23.0]))
    np.testing.assert_allclose(
        late.position_m, _only_place(plain.positions(["A"], [5.0])).position_m, atol=1e-6
    )


def test_times_without_overlap_are_a_one_line_error_with_both_intervals() -> None:
    settings = VehicleSettings(time_offset_s=2.5)
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], _straight(0.0), settings)
    with pytest.raises(KgcpError) as caught:
        target_positions.positions(["A", "A"], [3600.0, 3660.0])
    message = str(caught.value)
    for number in ("01:00:00", "01:01:00", "00:00:00", "00:00:10", "2.5"):
        assert number in message
    assert "\n" not in message


def test_a_target_without_any_position_is_an_error_with_a_remedy() -> None:
    with pytest.raises(KgcpError, match="no target has a position"):
        TargetPositions.of(_CRS, [Target(_RING)], None, VehicleSettings())
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], _straight(0.0), _LEVER)
    with pytest.raises(KgcpError, match="no frame has a time"):
        target_positions.positions(["A"], [None])
    with pytest.raises(KgcpError, match="'A' and 'B' share one lever_arm_m"):
        target_positions.positions(["A", "B"], [1.0, 1.0])


@pytest.mark.skipif(not _FLIGHTS.is_dir(), reason="needs the shared test flights")
@pytest.mark.parametrize("name", _NAMES)
def test_positions_and_reference_poses_agree_with_an_independent_truth(name: str) -> None:
    flight = read_flight(_FLIGHTS / name / "flight")
    assert flight.vehicle is not None
    assert flight.reference is not None
    assert flight.times_file is not None
    assert flight.crs is not None
    with (_FLIGHTS / name / "truth.csv").open() as stream:
        truth = list(csv.DictReader(stream))
    with flight.times_file.open() as stream:
        times: list[float | None] = [parse_time(row["time"]) for row in csv.DictReader(stream)]
    target_positions = TargetPositions.of(
        flight.crs,
        flight.targets,
        read_trajectory(flight.vehicle.trajectory_file, flight.crs),
        flight.vehicle.settings,
    )
    positions = target_positions.positions(["A"] * len(truth), times)
    enu = np.array(
        [position.position_m for position in positions if isinstance(position, TargetPosition)]
    )
    expected = np.array([[float(row[axis]) for axis in "XYZ"] for row in truth])
    assert len(enu) == len(truth)
    np.testing.assert_allclose(
        target_positions.local_frame.map_from_enu(enu), expected, atol=0.5e-3
    )

    poses = read_reference_poses(flight.reference.file)
    assert poses.frames == tuple(row["frame"] for row in truth)
    centres = target_positions.local_frame.enu_from_map(poses.position_map)
    grids = np.array([target_positions.local_frame.grid_rotation(centre) for centre in centres])
    enu_from_camera = grids @ rotation_from_opk(poses.opk_deg) @ CAMERA_FROM_PHOTO
    in_camera = np.einsum("nji,nj->ni", enu_from_camera, enu - centres)
    seen = np.array([row["present"] == "1" for row in truth])
    distance = np.array([float(row["distance"] or "nan") for row in truth])
    residual = (np.linalg.norm(in_camera, axis=1) - distance)[seen]
    assert abs(residual.mean()) < 0.003  # the poses carry 3 mm of noise along each axis
    assert 0.0015 < residual.std() < 0.006
    centre_px = np.array([[float(row["x"] or "nan"), float(row["y"] or "nan")] for row in truth])
    offset_px = (flight.camera.project(in_camera) - centre_px)[seen]
    sd_px = 2300.0 * np.hypot(math.radians(0.003), 0.003 / distance[seen, None])
    assert 0.6 < np.sqrt(np.mean((offset_px / sd_px) ** 2)) < 1.5


def test_a_full_covariance_of_the_trajectory_keeps_its_correlations() -> None:
    cov = np.array([[4.0, 2.5, -1.0], [2.5, 3.0, 0.5], [-1.0, 0.5, 9.0]]) * 1e-4
    base = _straight(30.0, np.sqrt(np.diag(cov)))
    n = len(base.time_s)
    growing = cov * np.linspace(1.0, 3.0, n)[:, None, None]  # threefold after 10 s
    trajectory = dataclasses.replace(base, cov_position_m2=growing)
    target_positions = TargetPositions.of(_CRS, [Target(_RING)], trajectory, VehicleSettings())
    position = _only_place(target_positions.positions(["A"], [5.03]))
    assert position.cov_m2 is not None
    grid = target_positions.local_frame.grid_rotation(position.position_m)
    np.testing.assert_allclose(grid.T @ position.cov_m2 @ grid, cov * 2.006, atol=1e-12)
