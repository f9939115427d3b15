from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Measurement, Miss
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings, Method
from kgcp.targets.layout import Ring, Target

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]
SETTINGS = DetectSettings(method=Method.PAPER)
OTHER_CODE = (0.0, 60.0, 150.0, 240.0)


def other_plate(target: Target) -> Target:
    """A plate with another main code, but the same replica."""
    return Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, OTHER_CODE), target.replicas)


def measured(frame: GreyArray, camera: Camera, target: Target) -> list[Measurement]:
    outcomes = measure_frame(frame, camera, (target,), SETTINGS)
    return [outcome for outcome in outcomes if isinstance(outcome, Measurement)]


@pytest.mark.parametrize(
    ("radius_px", "centre_px", "percent"),
    [(9.0, 0.1, 1.0), (13.0, 0.06, 0.5), (30.0, 0.04, 0.15), (100.0, 0.04, 0.1)],
)
@pytest.mark.parametrize("turn_deg", [10.0, 200.0])
def test_distance_and_centre_of_the_plate_are_right(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    radius_px: float,
    centre_px: float,
    percent: float,
    turn_deg: float,
) -> None:
    pose = place_plate((205.4, 190.7), radius_px, tilt_deg=22.0, way_deg=200.0, turn_deg=turn_deg)
    (measurement,) = measured(draw_frame((target, pose)), camera, target)
    truth_px = camera.project(pose.translation_m)
    assert measurement.ring == "A"
    assert measurement.score > 0.95
    assert np.linalg.norm(measurement.centre_px - truth_px) < centre_px
    assert measurement.pose.distance_m == pytest.approx(pose.distance_m, rel=0.01 * percent)
    heading = measurement.heading_deg - image_heading_deg(camera, pose)
    assert abs((heading + 180.0) % 360.0 - 180.0) < 1.5
    assert measurement.appearance.radius_px == pytest.approx(radius_px, rel=0.03)


@pytest.mark.parametrize("way_deg", [0.0, 75.0, 160.0, 290.0])
def test_the_image_of_a_large_ring_decides_between_its_two_poses(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame, way_deg: float
) -> None:
    pose = place_plate((260.0, 170.0), 90.0, tilt_deg=25.0, way_deg=way_deg, turn_deg=40.0)
    (measurement,) = measured(draw_frame((target, pose)), camera, target)
    np.testing.assert_allclose(measurement.pose.rotation, pose.rotation, atol=0.01)
    other = measurement.alternative
    assert other is not None
    assert other.ambiguity > 0.2
    assert other.pose.distance_m == pytest.approx(measurement.pose.distance_m, rel=1e-6)
    ray = measurement.pose.translation_m / measurement.pose.distance_m
    assert other.pose.normal @ ray == pytest.approx(measurement.pose.normal @ ray, abs=0.01)


def test_overexposure_shows_as_an_edge_shift_and_as_clipped_pixels(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    pose = place_plate((240.0, 180.0), 40.0)
    normal, burnt = (
        measured(draw_frame((target, pose), black=0.08 * gain, white=0.8 * gain), camera, target)[0]
        for gain in (1.0, 2.0)
    )
    assert normal.appearance.edge_shift_px == pytest.approx(0.0, abs=0.06)
    assert burnt.appearance.edge_shift_px is not None
    assert 0.1 < burnt.appearance.edge_shift_px < 1.0
    assert normal.appearance.saturated == 0.0
    assert 0.2 < burnt.appearance.saturated < 0.5  # disc and dots
    assert normal.appearance.black == pytest.approx(0.08, abs=0.03)
    assert normal.appearance.white == pytest.approx(0.8, abs=0.03)


@pytest.mark.parametrize("bits", [9, 10, 12, 14, 16])
def test_sixteen_bits_measure_like_eight(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame, bits: int
) -> None:
    """Files of 16 bits often hold fewer, which are not scaled to the full range."""
    pose = place_plate((240.0, 180.0), 25.0, tilt_deg=10.0)
    share = (2.0**bits - 1.0) / 65535.0
    shallow, deep = (
        measured(frame, camera, target)[0]
        for frame in (
            draw_frame((target, pose)),
            np.rint(draw_frame((target, pose), dtype=np.uint16) * share).astype(np.uint16),
        )
    )
    np.testing.assert_allclose(deep.centre_px, shallow.centre_px, atol=0.01)
    assert deep.pose.distance_m == pytest.approx(shallow.pose.distance_m, rel=2e-4)
    assert deep.appearance.white / share == pytest.approx(shallow.appearance.white, abs=0.01)


@pytest.mark.parametrize("radius_px", [14.0, 25.0, 60.0])
def test_a_sensor_that_saturates_below_its_files_range_measures_like_any_other(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    radius_px: float,
) -> None:
    """Twelve bits in files of sixteen: burnt plate is not mistaken for something else."""
    pose = place_plate((240.0, 180.0), radius_px, tilt_deg=10.0)
    burnt = draw_frame((target, pose), black=0.15, white=1.6, ground=0.5)
    settings = DetectSettings()
    usual, low = (
        measure_frame(frame, camera, (target,), settings)[0]
        for frame in (burnt, burnt.astype(np.uint16) * 16)
    )
    assert isinstance(usual, Measurement)
    assert isinstance(low, Measurement)
    assert usual.uncertainty is not None
    assert low.uncertainty is not None
    sd_m = usual.uncertainty.sd_distance_m
    assert low.pose.distance_m == pytest.approx(usual.pose.distance_m, abs=0.1 * sd_m)
    assert low.uncertainty.sd_distance_m == pytest.approx(sd_m, rel=0.1)
    assert usual.appearance.white == 1.0
    assert low.appearance.white == pytest.approx(16.0 * 255.0 / 65535.0)
    assert low.appearance.saturated == pytest.approx(usual.appearance.saturated, abs=0.01)


def test_two_plates_of_one_code_are_two_instances(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    plates = [(target, place_plate((x, 180.0), 40.0, turn_deg=x)) for x in (110.0, 340.0)]
    measurements = measured(draw_frame(*plates), camera, target)
    assert [measurement.instance for measurement in measurements] == [0, 1]
    assert sorted(round(measurement.centre_px[0], -1) for measurement in measurements) == [110, 340]
    assert measurements[0].score >= measurements[1].score


def test_each_target_has_its_own_outcome_in_order(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    other = other_plate(target)
    frame = draw_frame((target, place_plate((150.0, 150.0), 50.0)))
    found, missed = examine(frame, camera, (target, other), SETTINGS).outcomes
    assert isinstance(found, Measurement)
    assert isinstance(missed, Miss)
    assert missed == Miss("B", Reason.NO_CANDIDATE), "the only ring is that of A"


def test_the_replica_is_used_if_the_frame_cuts_the_ring(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    pose = place_plate((240.0, 40.0), 90.0, turn_deg=35.0)
    (measurement,) = measured(draw_frame((target, pose)), camera, target)
    assert measurement.ring == "A-inner"
    assert measurement.target == "A"
    assert np.linalg.norm(measurement.centre_px - camera.project(pose.translation_m)) < 0.1
    assert measurement.pose.distance_m == pytest.approx(pose.distance_m, rel=0.01)
    assert measurement.appearance.radius_px == pytest.approx(90.0, rel=0.02)


def test_the_replica_on_another_plate_is_not_this_target(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((other_plate(target), place_plate((240.0, 180.0), 90.0)))
    (outcome,) = measure_frame(frame, camera, (target,), SETTINGS)
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.OTHER_CODE
    assert outcome.outline is not None
    assert outcome.outline.a == pytest.approx(90.0, rel=0.02), "the main ring has failed"
    assert "flight.toml has 0, 43, 78, 180 for A" in outcome.detail


@pytest.mark.parametrize("method", Method)
def test_rejections_do_not_keep_the_frame_in_memory(
    method: Method,
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
) -> None:
    """An exception that is kept keeps all frames of its traceback, and their pixels."""
    frame = draw_frame((other_plate(target), place_plate((240.0, 180.0), 90.0)))
    pixels = weakref.ref(frame)
    gc.collect()
    gc.disable()
    try:
        examination = examine(frame, camera, (target,), DetectSettings(method=method))
        assert any(each.reason for each in examination.considered)
        del frame
        assert pixels() is None
    finally:
        gc.enable()


def test_an_empty_frame_has_no_candidate(
    target: Target, camera: Camera, draw_frame: DrawFrame
) -> None:
    (outcome,) = measure_frame(draw_frame(), camera, (target,), SETTINGS)
    assert outcome == Miss("A", Reason.NO_CANDIDATE)


def test_a_ring_of_other_proportions_is_refused(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    ring = target.ring
    thick = Target(Ring("T", 0.9, 0.36, ring.code_diameter_m, 0.12, ring.code_deg))
    frame = draw_frame((thick, place_plate((240.0, 180.0), 60.0)))
    (outcome,) = measure_frame(frame, camera, (Target(ring),), SETTINGS)
    assert isinstance(outcome, Miss)
    assert outcome.reason is Reason.CODE_MISMATCH


def test_the_same_frame_gives_the_same_numbers(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((target, place_plate((240.0, 180.0), 20.0, tilt_deg=math.pi)))
    first, second = (measured(frame, camera, target)[0] for _ in range(2))
    np.testing.assert_array_equal(first.pose.rotation, second.pose.rotation)
    np.testing.assert_array_equal(first.centre_px, second.centre_px)
