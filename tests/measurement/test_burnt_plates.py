"""Plates that are burnt white in compressed frames: errors and deviations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.adjustment.pixels import Sample, select_pixels
from kgcp.measurement.records import InitialPose, Measurement
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Sensor, ToneCurve
from kgcp.simulation.light_field import PlateLight, Shade
from tests.measurement.jpeg import compressed

LENS = Camera(420, 340, 900.0, 901.0, 208.2, 171.7)


@pytest.mark.parametrize(
    ("response", "tone"),
    [(Response.LINEAR, ToneCurve.LINEAR), (Response.SRGB, ToneCurve.SRGB)],
)
@pytest.mark.parametrize(("radius_px", "percent"), [(60.0, 0.02), (110.0, 0.01)])
def test_compressed_burnt_plates_are_measured_as_well_as_others(
    photograph: Callable[..., GreyArray],
    start_near: Callable[..., InitialPose],
    *,
    response: Response,
    tone: ToneCurve,
    radius_px: float,
    percent: float,
) -> None:
    """If grey values beside clipped ones count as exact, these rings are off by up to 0.4 %."""
    camera, sensor, standardised = replace(LENS, response=response), Sensor(tone=tone), []
    for seed in range(3):
        rng = np.random.default_rng(40 + seed)
        ray = np.append(camera.undistort(np.array([210.3, 170.6])), 1.0)
        rotation = Rotation.from_rotvec(np.radians([*rng.uniform(-12.0, 12.0, 2), 71.0]))
        pose = Pose(rotation.as_matrix(), ray * 0.45 * camera.mean_focal_px / radius_px)
        grey = photograph(camera, pose, rng, sensor=sensor, gain=2.0)
        start = start_near(camera, pose, rng)
        seen = measure_by_model(compressed(grey, 82), camera, TARGET_PLATE.target, start)
        assert seen.uncertainty is not None
        off_m = seen.pose.distance_m - pose.distance_m
        assert abs(off_m) < 0.01 * percent * pose.distance_m
        standardised.append(off_m / seen.uncertainty.sd_distance_m)
    assert np.abs(standardised).max() < 3.5


def test_burnt_white_in_full_light_is_not_masked(
    photograph: Callable[..., GreyArray],
    start_near: Callable[..., InitialPose],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Clipped white is darker than its modelled light; it was once taken for a hidden part."""
    shares = []

    def select(*asked: Any, **more: Any) -> Sample:  # noqa: ANN401 - whatever it is asked
        sample = select_pixels(*asked, **more)
        shares.append(np.mean(sample.pixels[0] > 208.0))
        return sample

    monkeypatch.setattr("kgcp.measurement.adjustment.random_levels.select_pixels", select)
    pose, seen = half_in_shade(photograph, start_near, Response.LINEAR, ToneCurve.LINEAR, 0.0)
    assert seen.distance_m == pytest.approx(pose.distance_m, rel=2e-4)
    assert shares == pytest.approx([0.5] * len(shares), abs=0.05)
    assert len(shares) >= 1


@pytest.mark.parametrize(
    ("response", "tone"),
    [
        (Response.LINEAR, ToneCurve.LINEAR),
        (Response.SRGB, ToneCurve.SRGB),
        (Response.UNKNOWN, ToneCurve.SRGB),
    ],
)
def test_the_edge_shift_follows_the_light_on_each_edge(
    photograph: Callable[..., GreyArray],
    start_near: Callable[..., InitialPose],
    response: Response,
    tone: ToneCurve,
) -> None:
    """Computed from the visible white, 1, none of the edges would seem displaced."""
    shifts_px = []
    for edge_m in (0.7, 0.44, 0.0):  # none in shade, hardly any, half of them
        _, seen = half_in_shade(photograph, start_near, response, tone, edge_m)
        shifts_px.append(seen.appearance.edge_shift_px)
    even, hardly, half = shifts_px
    assert even is not None
    assert even > 0.3
    assert hardly == pytest.approx(even, abs=0.03)
    assert half is not None
    assert 0.35 * even < half < 0.85 * even


def half_in_shade(
    photograph: Callable[..., GreyArray],
    start_near: Callable[..., InitialPose],
    response: Response,
    tone: ToneCurve,
    edge_m: float,
) -> tuple[Pose, Measurement]:
    """Measure a plate that is burnt where the light falls on it: left of an edge."""
    camera, rng = replace(LENS, response=response), np.random.default_rng(7)
    ray = np.append(camera.undistort(np.array([208.0, 170.0])), 1.0)
    pose = Pose(np.eye(3), ray * 0.45 * camera.mean_focal_px / 46.0)
    field = PlateLight(light_left=0.5, shades=(Shade((1.0, 0.0), 50.0 + edge_m, 100.0, 0.05),))
    grey = photograph(camera, pose, rng, sensor=Sensor(tone=tone), gain=1.8, field=field)
    start = start_near(camera, pose, rng)
    return pose, measure_by_model(grey, camera, TARGET_PLATE.target, start)
