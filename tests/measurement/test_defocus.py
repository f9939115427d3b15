"""Rings out of focus: a point becomes a disc of light, which is not a Gaussian."""

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
from kgcp.measurement.adjustment import fit_target
from kgcp.measurement.adjustment.covariance import PoseCovariance, pose_covariance
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.records import InitialPose
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.light_field import PlateLight, Shade
from kgcp.simulation.point_spread import Aberration

LENS = Camera(420, 340, 900.0, 901.0, 208.2, 171.7, response=Response.LINEAR)
DEFOCUSED = Optics(0.7, aberration=Aberration(defocus_px=2.0))
LINEAR, SRGB = Sensor(), Sensor(tone=ToneCurve.SRGB)
Photograph = Callable[..., GreyArray]
StartNear = Callable[..., InitialPose]


def some_pose(rng: np.random.Generator, radius_px: float) -> Pose:
    ray = np.append(LENS.undistort(np.array([210.0, 170.0]) + rng.uniform(-20.0, 20.0, 2)), 1.0)
    tilt = Rotation.from_rotvec(np.radians([*rng.uniform(-20.0, 20.0, 2), 0.0]))
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True)
    return Pose((tilt * turn).as_matrix(), ray * 0.45 * LENS.mean_focal_px / radius_px)


def shadow_edge(rng: np.random.Generator) -> PlateLight:
    way = rng.uniform(0.0, 2.0 * math.pi)
    shade = Shade((math.cos(way), math.sin(way)), 50.0 + rng.uniform(-0.3, 0.3), 100.0, 0.06)
    return PlateLight(light_left=0.5, shades=(shade,))


def errors_of(
    photograph: Photograph,
    start_near: StartNear,
    radius_px: float,
    sensor: Sensor,
    light: Callable[[np.random.Generator], PlateLight | None],
) -> tuple[FloatArray, FloatArray]:
    """Errors of six distances [%], and in units of their deviations."""
    percent, sigmas = [], []
    camera = LENS if sensor is LINEAR else replace(LENS, response=Response.UNKNOWN)
    for seed in range(6):
        rng = np.random.default_rng(900 + seed)
        pose = some_pose(rng, radius_px)
        grey = photograph(
            camera, pose, rng, sensor=sensor, gain=0.8, field=light(rng), optics=DEFOCUSED
        )
        seen = measure_by_model(grey, camera, TARGET_PLATE.target, start_near(camera, pose, rng))
        percent.append(100.0 * (seen.distance_m / pose.distance_m - 1.0))
        sigmas.append((seen.distance_m - pose.distance_m) / seen.sd_distance_m)
    return np.array(percent), np.array(sigmas)


@pytest.mark.parametrize(
    ("radius_px", "sensor", "mean_percent"),
    [(40.0, LINEAR, 0.004), (18.0, LINEAR, 0.02), (12.0, LINEAR, 0.06), (18.0, SRGB, 0.03)],
)
def test_distances_out_of_focus_are_right_and_as_uncertain_as_said(
    photograph: Photograph,
    start_near: StartNear,
    radius_px: float,
    sensor: Sensor,
    mean_percent: float,
) -> None:
    """Taken for a Gaussian, defocus of 2 px put rings of 12 to 18 px 2 to 3 σ too near."""
    percent, sigmas = errors_of(photograph, start_near, radius_px, sensor, lambda _: None)
    assert abs(percent.mean()) < mean_percent
    assert 0.2 < math.sqrt(np.mean(sigmas**2)) < 1.5


def test_defocus_shows_beneath_a_shadow(
    photograph: Photograph, start_near: StartNear, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits: list[TargetFit] = []

    def kept(fit: TargetFit) -> PoseCovariance:
        fits.append(fit)
        return pose_covariance(fit)

    monkeypatch.setattr(fit_target, "pose_covariance", kept)
    percent, sigmas = errors_of(photograph, start_near, 45.0, LINEAR, shadow_edge)
    varying = [fit for fit in fits if fit.level_equations is not None]
    assert len(varying) >= 6
    assert all(-1.0 < fit.parameters.blur.kurtosis < -0.2 for fit in varying)
    assert np.sqrt(np.mean(percent**2)) < 0.012
    assert 0.3 < math.sqrt(np.mean(sigmas**2)) < 1.5
