"""The reasons of misses name what is visible in the image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Measurement, Miss
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]
SETTINGS = DetectSettings()


def plate_b() -> Target:
    return Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 60.0, 150.0, 240.0)))


@pytest.fixture
def bare(target: Target) -> Target:
    """The target without its replica."""
    return Target(target.ring)


def miss(frame: GreyArray, camera: Camera, target: Target) -> Miss:
    (outcome,) = measure_frame(frame, camera, (target,), SETTINGS)
    assert isinstance(outcome, Miss)
    return outcome


def test_a_ring_below_the_smallest_radius_is_reported_as_too_small(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    pose = place_plate((240.0, 180.0), 5.2, turn_deg=30.0)
    found = miss(draw_frame((plate_b(), pose)), camera, bare)
    assert found.reason is Reason.TOO_SMALL
    assert found.detail.startswith("ring at (240, 180), radius ")
    assert found.candidates == 1


def test_a_ring_with_blurred_away_dots_is_reported_as_too_blurred(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    pose = place_plate((240.0, 180.0), 14.0, turn_deg=30.0)
    found = miss(draw_frame((bare, pose), blur_px=4.2), camera, bare)
    assert found.reason is Reason.TOO_BLURRED


def test_a_covered_ring_is_reported_as_hidden(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((bare, place_plate((240.0, 180.0), 40.0, turn_deg=30.0))).copy()
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    sector = np.abs(np.degrees(np.arctan2(y - 180.0, x - 240.0)) - 78.0) < 50.0
    frame[sector & (np.hypot(x - 240.0, y - 180.0) < 60.0)] = 40
    found = miss(frame, camera, bare)
    assert found.reason is Reason.HIDDEN
    assert "of its edge not seen" in found.detail


def test_another_code_is_reported_with_its_numbers(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((plate_b(), place_plate((240.0, 180.0), 30.0, turn_deg=30.0)))
    found = miss(frame, camera, bare)
    assert found.reason is Reason.OTHER_CODE
    assert "a dot is off by" in found.detail


def test_the_ring_of_a_measured_target_does_not_explain_another_target_s_miss(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    plates = [(bare, place_plate((140.0, 180.0), 40.0))]
    seen, missed = measure_frame(draw_frame(*plates), camera, (bare, plate_b()), SETTINGS)
    assert isinstance(seen, Measurement)
    assert missed == Miss("B", Reason.NO_CANDIDATE)
    third = Target(Ring("C", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 90.0, 130.0, 220.0)))
    plates.append((third, place_plate((340.0, 180.0), 40.0)))
    seen, missed = measure_frame(draw_frame(*plates), camera, (bare, plate_b()), SETTINGS)
    assert isinstance(seen, Measurement)
    assert isinstance(missed, Miss)
    assert (missed.reason, missed.candidates) == (Reason.OTHER_CODE, 1)
    assert "ring at (340, 180)" in missed.detail


def test_all_examined_rings_are_kept(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    plates = [
        (bare, place_plate((140.0, 180.0), 40.0)),
        (plate_b(), place_plate((340.0, 180.0), 40.0)),
    ]
    examination = examine(draw_frame(*plates), camera, (bare, plate_b()), SETTINGS)
    assert all(isinstance(outcome, Measurement) for outcome in examination.outcomes)
    dropped = {(one.target, one.reason) for one in examination.considered}
    assert dropped == {
        *(("A", None), ("A", Reason.OTHER_CODE), ("B", None), ("B", Reason.OTHER_CODE)),
    }


def test_a_code_that_may_be_due_to_chance_is_refused(
    bare: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((bare, place_plate((240.0, 180.0), 9.0, turn_deg=30.0)))
    (seen,) = measure_frame(frame, camera, (bare,), SETTINGS)
    assert isinstance(seen, Measurement)
    (missed,) = measure_frame(frame, camera, (bare,), DetectSettings(false_alarm=1e-30))
    assert isinstance(missed, Miss)
    assert missed.reason is Reason.CODE_MISMATCH
    assert "occurs by chance" in missed.detail
