"""Plates that move in the image while the rows of a frame are exposed one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.image_model.rolling_shutter import RollingShutter
from kgcp.measurement.plate_prior import PlatePrior, SceneRotation
from kgcp.measurement.records import InitialPose, Measurement
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics
from kgcp.simulation.rolling_shutter import RowMotion

READOUT_S = 0.03
CAMERA = Camera(
    width=640,
    height=480,
    fx=900.0,
    fy=902.0,
    cx=318.2,
    cy=241.7,
    k1=-0.05,
    k2=0.03,
    response=Response.LINEAR,
    readout_s=READOUT_S,
)
FRAMES = 6
Photograph = Callable[..., GreyArray]
StartNear = Callable[..., InitialPose]


def some_pose(rng: np.random.Generator) -> Pose:
    ray = np.append(CAMERA.undistort(np.array([320.0, 240.0]) + rng.uniform(-150, 150, 2)), 1.0)
    tilt = Rotation.from_rotvec(np.radians([*rng.uniform(-25.0, 25.0, 2), 0.0]))
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)
    return Pose((tilt * turn).as_matrix(), ray * 0.45 * CAMERA.mean_focal_px / 34.0)


def measured(
    photograph: Photograph, start_near: StartNear, seed: int, *, is_known: bool
) -> tuple[Pose, Measurement]:
    """Measure a plate that moves as the a-priori deviation has it."""
    rng = np.random.default_rng(70 + seed)
    pose = some_pose(rng)
    turn = math.radians(CAMERA.motion_sd_deg_s) * rng.standard_normal(2)  # about x and y
    centre_px = CAMERA.project(pose.translation_m[None])[0]
    later = Rotation.from_rotvec([*(1e-3 * turn), 0.0]).apply(pose.translation_m)
    px_s = (CAMERA.project(later[None])[0] - centre_px) / 1e-3
    per_row = px_s * READOUT_S / (CAMERA.height - 1)
    motion = RowMotion((float(per_row[0]), float(per_row[1])), float(centre_px[1]), CAMERA.height)
    grey = photograph(CAMERA, pose, rng, gain=0.8, optics=Optics(0.8, motion=motion))
    rotation = SceneRotation((float(turn[0]), float(turn[1]), 0.0), math.radians(0.1))
    prior = PlatePrior(rotation=rotation if is_known else None)
    return pose, measure_by_model(
        grey, CAMERA, TARGET_PLATE.target, start_near(CAMERA, pose, rng), prior
    )


def standardised(pose: Pose, seen: Measurement) -> float:
    assert seen.uncertainty is not None
    return (seen.pose.distance_m - pose.distance_m) / seen.uncertainty.sd_distance_m


def test_deviations_cover_unknown_motion(photograph: Photograph, start_near: StartNear) -> None:
    both = [measured(photograph, start_near, seed, is_known=False) for seed in range(FRAMES)]
    percent = [100.0 * abs(seen.pose.distance_m / pose.distance_m - 1.0) for pose, seen in both]
    assert max(percent) > 0.05
    assert 0.3 < math.sqrt(np.mean([standardised(*each) ** 2 for each in both])) < 1.6


def test_known_motion_is_corrected(photograph: Photograph, start_near: StartNear) -> None:
    both = [measured(photograph, start_near, seed, is_known=True) for seed in range(FRAMES)]
    percent = [100.0 * abs(seen.pose.distance_m / pose.distance_m - 1.0) for pose, seen in both]
    assert max(percent) < 0.02
    assert 0.3 < math.sqrt(np.mean([standardised(*each) ** 2 for each in both])) < 1.6


def test_without_readout_a_motion_changes_nothing(
    photograph: Photograph, start_near: StartNear
) -> None:
    still = replace(CAMERA, readout_s=0.0)
    rng = np.random.default_rng(5)
    pose = some_pose(rng)
    grey, start = photograph(still, pose, rng), start_near(still, pose, rng)
    turning = PlatePrior(rotation=SceneRotation((0.1, 0.2, 0.3), 0.1))
    plain = measure_by_model(grey, still, TARGET_PLATE.target, start)
    seen = measure_by_model(grey, still, TARGET_PLATE.target, start, turning)
    assert seen.pose.matrix.tobytes() == plain.pose.matrix.tobytes()
    assert seen.uncertainty is not None
    assert plain.uncertainty is not None
    assert seen.uncertainty.pose_cov.tobytes() == plain.uncertainty.pose_cov.tobytes()


@pytest.mark.parametrize("velocity", [(0.2, -0.1, 0.0), (0.05, 0.3, -0.4)])
def test_rays_are_those_of_the_rotated_scene(velocity: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    rays = np.zeros((6, 5))
    rays[:2] = rng.uniform(-0.3, 0.3, (2, 5))
    rows = rng.uniform(0.0, 480.0, 5)
    shutter = RollingShutter.of(CAMERA, rows, 200.0, SceneRotation(velocity, 0.0))
    moved = shutter.rays_at_one_moment(rays)
    assert np.allclose(shutter.delay_s, (rows - 200.0) * READOUT_S / 479.0)
    for index, delay_s in enumerate(shutter.delay_s):
        direction: FloatArray = np.append(rays[:2, index], 1.0)
        earlier = Rotation.from_rotvec(-delay_s * np.array(velocity)).apply(direction)
        assert np.allclose(moved[:2, index], earlier[:2] / earlier[2], atol=3e-5)
