"""Unknowns that are estimated after all others: smoothing along contours, an inner circle's growth.

Smoothing is estimated from one frame, and combined over all frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.adjustment.smoothing import (
    CameraSmoothing,
    camera_smoothing,
    with_smoothing,
)
from kgcp.measurement.records import ContourSmoothing, InitialPose, Measurement
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Sensor, ToneCurve

CAMERA = Camera(300, 260, 1310.0, 1306.0, 141.2, 131.7, response=Response.UNKNOWN)
RADIUS_PX = 22.0
SMOOTHING_PX2 = 0.5
FILM = Sensor(tone=ToneCurve.FILM, sharpening=0.6, sharpening_px=1.1)


def smoothed_plate(metres_per_px: float) -> object:
    """The target's plate as it looks, seen from above, after smoothing along its contours."""
    ring = TARGET_PLATE.target.ring
    diameters = {
        name: getattr(ring, name) - SMOOTHING_PX2 * metres_per_px**2 * 2.0 / getattr(ring, name)
        for name in ("outer_diameter_m", "inner_diameter_m", "dot_diameter_m")
    }
    target = replace(TARGET_PLATE.target, ring=replace(ring, **diameters))
    return replace(TARGET_PLATE, target=target)


def pose_of(seed: int) -> Pose:
    turn = Rotation.from_euler("z", 40.0 * seed, degrees=True).as_matrix()
    ray = np.array([0.01 * (seed % 3), -0.012, 1.0])
    return Pose(turn, ray * 0.45 * CAMERA.mean_focal_px / RADIUS_PX)


@pytest.fixture(scope="module")
def smoothed(
    photograph: Callable[..., GreyArray], start_near: Callable[..., InitialPose]
) -> list[tuple[Measurement, Pose]]:
    """Measurements of smoothed plates, and their true poses."""
    plate = smoothed_plate(0.45 / RADIUS_PX)
    rows = []
    for seed in range(6):
        rng, pose = np.random.default_rng(seed), pose_of(seed)
        grey = photograph(CAMERA, pose, rng, plate=plate, sensor=FILM)
        start = start_near(CAMERA, pose, rng)
        rows.append((measure_by_model(grey, CAMERA, TARGET_PLATE.target, start), pose))
    return rows


def smoothing_of(measurement: Measurement) -> ContourSmoothing:
    assert measurement.smoothing is not None
    return measurement.smoothing


def percent_off(measurement: Measurement, truth: Pose) -> float:
    return 100.0 * (measurement.distance_m / truth.distance_m - 1.0)


def test_smoothing_is_estimated_and_the_flight_s_value_corrects_distances(
    smoothed: list[tuple[Measurement, Pose]],
) -> None:
    seen = [smoothing_of(measurement) for measurement, _ in smoothed]
    learnt = camera_smoothing(seen)
    assert 0.35 < learnt.mean_px2 < 0.6
    sigmas = [(each.seen_px2 - SMOOTHING_PX2) / each.sd_seen_px2 for each in seen]
    assert 0.2 < np.sqrt(np.mean(np.square(sigmas))) < 2.5
    nothing = CameraSmoothing(0.0, 1e-9, 1e-9)
    without = [percent_off(with_smoothing(CAMERA, m, nothing), truth) for m, truth in smoothed]
    with_it = [percent_off(with_smoothing(CAMERA, m, learnt), truth) for m, truth in smoothed]
    assert 0.08 < np.mean(without) < 0.2, "½ β / R² of smaller contours, all of them"
    assert abs(np.mean(with_it)) < 0.03


def test_a_measurement_can_be_corrected_repeatedly(
    smoothed: list[tuple[Measurement, Pose]],
) -> None:
    first, _ = smoothed[0]
    surely, hardly = CameraSmoothing(0.3, 0.01, 1e-6), CameraSmoothing(0.3, 0.2, 1e-6)
    once = with_smoothing(CAMERA, first, surely)
    twice = with_smoothing(CAMERA, with_smoothing(CAMERA, first, hardly), surely)
    np.testing.assert_allclose(twice.pose.translation_m, once.pose.translation_m, rtol=1e-10)
    assert twice.sd_distance_m == pytest.approx(once.sd_distance_m, rel=1e-6)
    assert with_smoothing(CAMERA, first, hardly).sd_distance_m > 1.2 * once.sd_distance_m
    assert once.alternative is not None
    assert first.alternative is not None
    moved_m = once.distance_m - first.distance_m
    other_m = once.alternative.pose.distance_m - first.alternative.pose.distance_m
    assert other_m == pytest.approx(moved_m, rel=0.05)
    known = replace(first, smoothing=None)
    assert with_smoothing(CAMERA, known, surely) is known


def test_smoothing_of_single_frames_is_as_good_as_stated() -> None:
    rng = np.random.default_rng(3)
    sigmas: list[FloatArray] = []
    for _ in range(100):
        truth = rng.normal(0.0, 0.1) + rng.normal(0.0, abs(rng.normal(0.0, 0.05)), 15)
        sd = rng.uniform(0.02, 0.2, 15)
        seen = truth + rng.normal(0.0, sd)
        alike = [ContourSmoothing(*pair, np.zeros(6)) for pair in zip(seen, sd, strict=True)]
        learnt = camera_smoothing(alike)
        combined = np.array([learnt.in_measurement(each) for each in alike])
        sigmas.append((combined[:, 0] - truth) / combined[:, 1])
    assert 0.85 < np.sqrt(np.mean(np.square(sigmas))) < 1.15


@pytest.mark.parametrize("growth", [-0.01, 0.0, 0.01])
@pytest.mark.parametrize(
    ("diameter", "seen"),
    [("inner_diameter_m", "inner_growth"), ("code_diameter_m", "dots_growth")],
)
def test_a_circle_of_another_size_shows(
    photograph: Callable[..., GreyArray],
    start_near: Callable[..., InitialPose],
    diameter: str,
    seen: str,
    growth: float,
) -> None:
    ring = TARGET_PLATE.target.ring
    printed = replace(ring, **{diameter: getattr(ring, diameter) * (1.0 + growth)})
    plate = replace(TARGET_PLATE, target=replace(TARGET_PLATE.target, ring=printed))
    camera = replace(CAMERA, response=Response.LINEAR)
    rng, pose = np.random.default_rng(3), pose_of(1)
    grey = photograph(camera, pose, rng, plate=plate)
    start = start_near(camera, pose, rng)
    measured = measure_by_model(grey, camera, TARGET_PLATE.target, start)
    assert getattr(measured.appearance, seen) == pytest.approx(growth, abs=0.0015)
