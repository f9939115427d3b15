from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("gtsam", reason="the adjustment's engine: pip install -e '.[aat]'")

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.aat import adjust
from benchmarks.aat.block import Block, project_all, simulate_block
from benchmarks.aat.figure import draw_benefit
from benchmarks.aat.gcps import (
    KgcpSet,
    distance_by_calibration,
    joint_covariance,
    measure_kgcps,
    nominal_target,
    render_window,
    window_of,
)
from benchmarks.aat.settings import BlockSettings, Control, random_stream
from benchmarks.aat.table import Trial, summarise, table_lines
from kgcp.geometry.camera import Camera
from kgcp.measurement.records import Measurement
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.simulation.ground import Ground

SMALL = replace(BlockSettings(), frames=12, tie_points=400, checks=6)
CAMERA = Camera(
    width=1600, height=1100, fx=1234.0, fy=1234.0, cx=790.0, cy=561.0, k1=-0.07, k2=0.05
)


@pytest.fixture(scope="module")
def block() -> Block:
    return simulate_block(SMALL, 3)


def odd_values() -> gtsam.Values:
    """Two poses, two points and a calibration, nothing of it round."""
    values = gtsam.Values()
    for index in range(2):
        turn = Rotation.from_euler("xyz", [170.0 + 9.0 * index, -8.0, 37.0], degrees=True)
        centre = np.array([5.0, -3.0 + index, 41.0])
        values.insert(index, gtsam.Pose3(gtsam.Rot3(turn.as_matrix()), centre))
        values.insert(10 + index, np.array([1.0 + 6.0 * index, 2.0, 0.7]))
    values.insert(20, adjust.calibration_of(CAMERA))
    values.insert(30, np.array([3e-4]))
    return values


def some_covariance(size: int) -> np.ndarray:
    root = np.random.default_rng(2).standard_normal((size, size))
    return 1e-3 * (root @ root.T + size * np.eye(size))


def factors() -> dict[str, gtsam.NoiseModelFactor]:
    rng = np.random.default_rng(1)
    slopes = np.array([0.017, 1e-3, -2e-3, 0.4, 0.02])
    return {
        "projection": gtsam.GeneralSFMFactor2Cal3DS2(
            np.array([700.0, 500.0]), gtsam.noiseModel.Isotropic.Sigma(2, 0.4), 0, 10, 20
        ),
        "centres": adjust.camera_centres([0, 1], rng.standard_normal((2, 3)), some_covariance(6)),
        "places": adjust.places([10, 11], rng.standard_normal((2, 3)), some_covariance(6)),
        "distance": adjust.distance([1, 10, 20, 30], 41.5, 0.01, slopes, np.arange(5.0)),
    }


@pytest.mark.parametrize("name", list(factors()))
def test_derivatives_are_those_of_the_residuals(name: str) -> None:
    factor, values = factors()[name], odd_values()
    whitened = factor.linearize(values).jacobian()[0]
    columns = []
    for key in list(factor.keys()):
        size = {0: 6, 1: 6, 10: 3, 11: 3, 20: 9, 30: 1}[key]
        for step in 1e-6 * np.eye(size):
            sides = []
            for sign in (1.0, -1.0):
                delta = values.zeroVectors()
                delta.update(one_vector(key, sign * step))
                sides.append(factor.whitenedError(values.retract(delta)))
            columns.append((sides[0] - sides[1]) / 2e-6)
    np.testing.assert_allclose(whitened, np.column_stack(columns), rtol=1e-5, atol=1e-4)


def one_vector(key: int, vector: np.ndarray) -> gtsam.VectorValues:
    vectors = gtsam.VectorValues()
    vectors.insert(key, vector)
    return vectors


def test_the_engine_projects_as_kgcp_does() -> None:
    values = odd_values()
    pose, point = values.atPose3(0), values.atPoint3(10)
    camera = gtsam.PinholeCameraCal3DS2(pose, values.atCal3DS2(20))
    seen = (point - pose.translation()) @ pose.rotation().matrix()
    np.testing.assert_allclose(camera.project(point), CAMERA.project(seen[None])[0], atol=1e-9)


def without_noise(block: Block) -> tuple[Block, KgcpSet]:
    """Return a block whose observations are the truth, but for the believed calibration."""
    image_points, ride = block.image_points, block.ride
    _, pixels = project_all(block.camera, block.views, image_points.points_enu_m)
    exact = replace(image_points, pixels=pixels[image_points.frame, image_points.point])
    gcps = image_points.points_enu_m[image_points.checks : image_points.checks + image_points.gcps]
    centres = np.array([view.position_enu_m for view in block.views])
    step = adjust.free_parameters(block.camera) - adjust.free_parameters(block.believed)
    poses = [
        view.pose_of(plate, place)
        for view, plate, place in zip(
            block.views, ride.enu_from_plate, ride.target_enu_m, strict=True
        )
    ]
    slopes = np.array([distance_by_calibration(block.believed, pose) for pose in poses])
    lengths = np.array([pose.distance_m for pose in poses])
    n = len(poses)
    kgcps = KgcpSet(
        frame=np.arange(n),
        position_enu_m=ride.target_enu_m,
        cov_m2=4e-4 * np.eye(3 * n),
        pixels=np.array([block.camera.project(pose.translation_m[None])[0] for pose in poses]),
        pixel_cov_px2=np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        distance_m=lengths - slopes @ step,
        sd_distance_m=np.full(n, 0.003),
        by_calibration=slopes,
        sd_common=2e-4,
    )
    return replace(block, image_points=exact, gnss_enu_m=centres, gcps_enu_m=gcps), kgcps


@pytest.mark.parametrize("control", list(Control))
def test_a_block_without_noise_returns_the_truth(block: Block, control: Control) -> None:
    exact, kgcps = without_noise(block)
    found = adjust.adjust(exact, kgcps, control, None)
    truth = exact.image_points.points_enu_m[: exact.image_points.checks]
    np.testing.assert_allclose(found.checks_enu_m, truth, atol=1e-5)
    true_calibration = adjust.free_parameters(block.camera)
    np.testing.assert_allclose(found.calibration, true_calibration, atol=2e-3)
    assert np.all(np.linalg.eigvalsh(found.cov_m2) > 0.0)


def test_more_control_predicts_better_heights(block: Block) -> None:
    exact, kgcps = without_noise(block)
    sds = [
        np.sqrt(np.diagonal(adjust.adjust(exact, kgcps, control, None).cov_m2)[2::3].mean())
        for control in (Control.GNSS, Control.KGCPS, Control.DISTANCES)
    ]
    assert sds[0] > 2.0 * sds[1] > 2.0 * sds[2]


def test_distances_follow_the_calibration_as_a_new_measurement_does(block: Block) -> None:
    ground = Ground.grown(random_stream(3, "ground"), SMALL.bend_radius_m)
    grey, first_px = render_window(block, ground, 5)
    steps = np.array([3.0, 2.0, -2.0, 1e-3, 2e-3])
    changed = replace(
        block.believed,
        fx=block.believed.fx + steps[0],
        fy=block.believed.fy + steps[0],
        cx=block.believed.cx + steps[1],
        cy=block.believed.cy + steps[2],
        k1=block.believed.k1 + steps[3],
        k2=block.believed.k2 + steps[4],
    )
    before, after = (
        measure_frame(grey, window_of(camera, first_px), (nominal_target(0.0),), DetectSettings())[
            0
        ]
        for camera in (block.believed, changed)
    )
    assert isinstance(before, Measurement)
    assert isinstance(after, Measurement)
    predicted_m = distance_by_calibration(block.believed, before.pose) @ steps
    assert predicted_m == pytest.approx(0.05, rel=0.2)  # 3 px of 2900 at 48 m
    moved_m = after.pose.distance_m - before.pose.distance_m
    assert moved_m == pytest.approx(predicted_m, abs=0.001)


def test_rendered_kgcps_are_where_the_target_was() -> None:
    block = simulate_block(replace(SMALL, frames=6), 4)
    kgcps = measure_kgcps(block)
    assert kgcps.frame.tolist() == list(range(6))
    error_m = (kgcps.position_enu_m - block.ride.target_enu_m).ravel()
    assert 3.0 < error_m @ np.linalg.solve(kgcps.cov_m2, error_m) < 40.0  # χ² of 18
    poses = [
        view.pose_of(plate, place)
        for view, plate, place in zip(
            block.views, block.ride.enu_from_plate, block.ride.target_enu_m, strict=True
        )
    ]
    pixels = np.array([block.camera.project(pose.translation_m[None])[0] for pose in poses])
    np.testing.assert_allclose(kgcps.pixels, pixels, atol=0.02)
    step = adjust.free_parameters(block.camera) - adjust.free_parameters(block.believed)
    scaled = kgcps.distance_m * block.ride.plate_scale + kgcps.by_calibration @ step
    assert np.abs(scaled - [pose.distance_m for pose in poses]).max() < 0.015


def test_neighbours_share_their_errors_as_the_conventions_say() -> None:
    cov = np.array([np.diag([4.0, 5.0, 9.0]), np.diag([5.0, 4.0, 10.0])])
    common = np.zeros((2, 3, 4))
    common[:, 2, 3] = 1.0
    joint = joint_covariance(np.array([0.0, 60.0]), cov, common, 60.0)
    np.testing.assert_allclose(joint[:3, :3], cov[0])
    np.testing.assert_allclose(joint[3:, 3:], cov[1])
    kept = np.exp(-1.0)
    expected = np.diag([kept * np.sqrt(20.0), kept * np.sqrt(20.0), kept * np.sqrt(72.0) + 1.0])
    np.testing.assert_allclose(joint[:3, 3:], expected, atol=1e-12)


def test_true_predictions_are_called_true() -> None:
    rng = np.random.default_rng(6)
    sd = np.array([0.01, 0.02, 0.03])
    cov = np.diag(np.tile(sd**2, 30))
    close = [Trial(sd * rng.standard_normal((30, 3)), cov, 0.5, 0.5) for _ in range(40)]
    far = [replace(trial, error_m=6.0 * trial.error_m) for trial in close]
    row = summarise(close, far)
    np.testing.assert_allclose(row.scatter, 1.0, atol=0.06)
    np.testing.assert_allclose(row.rms_m, sd, rtol=0.06)
    np.testing.assert_allclose(row.predicted_m, sd)
    assert row.whole_scatter == pytest.approx(1.0, abs=0.04)
    assert row.benefit == pytest.approx(6.0)
    lines = list(table_lines({("free", Control.KGCPS): row}))
    assert len(lines) == 3
    assert "| free | + KGCPs | " in lines[2]


def test_the_figure_is_light_and_always_the_same() -> None:
    rng = np.random.default_rng(7)
    trials = {
        (calibration, control): [
            Trial(np.tile(0.1 * rng.standard_normal(3), (24, 1)), 0.01 * np.eye(72), 0.5, 0.5)
            for _ in range(20)
        ]
        for calibration in ("free", "known")
        for control in Control
    }
    figure = draw_benefit(trials, BlockSettings().checks_along_m)
    assert figure.startswith(b"\x89PNG")
    assert len(figure) < 200_000
    assert draw_benefit(trials, BlockSettings().checks_along_m) == figure
