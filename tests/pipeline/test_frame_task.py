"""The first and the second look at one frame, and the resulting row of each target."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kgcp.errors import Reason
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.guided import Prediction
from kgcp.measurement.plain_prediction import PlainPrediction
from kgcp.measurement.plate_prior import NormalPrior, PlatePrior, SceneRotation
from kgcp.measurement.records import FrameResult, Measurement, Miss
from kgcp.pipeline.execution.journal import to_text
from kgcp.pipeline.execution.kept_frames import KeptFrames
from kgcp.pipeline.frame_task import (
    DetectionJob,
    FrameInput,
    GuidedInput,
    completed,
    examine_frame,
    examine_frame_again,
)
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import DECOY_PLATE, TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import PlainPlate, image_plate
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import PlainPolarity, PlainTarget

CAMERA = Camera(480, 360, 900.0, 904.0, 236.3, 184.2)
A = Target(replace(TARGET_PLATE.target.ring, sd_outer_diameter_m=1e-3))
B = Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 60.0, 150.0, 240.0)))
POSE = Pose(np.eye(3), np.array([0.5, -0.4, 30.0]))
FRAME_INPUT = FrameInput("a.png", 12.0, {})
STRICT = DetectSettings(min_score=1.0)  # more than any ring in a frame has
PREDICTION = Prediction(CAMERA.project(POSE.translation_m), 1.0, 13.5, 0.03, "a test")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("examine")
    irradiance = np.full((CAMERA.height, CAMERA.width), 0.3)
    image_plate(CAMERA, TARGET_PLATE, POSE, Optics(0.7)).paste(irradiance)
    decoy = Pose(np.eye(3), np.array([-3.0, 2.0, 30.0]))
    image_plate(CAMERA, DECOY_PLATE, decoy, Optics(0.7)).paste(irradiance)
    assert cv2.imwrite(
        str(path / "a.png"), Sensor().expose(irradiance, 0.9, np.random.default_rng(1))
    )
    return path


def look_twice(
    folder: Path, expected: dict[str, Prediction], settings: DetectSettings = STRICT
) -> tuple[FrameResult, FrameResult]:
    job = DetectionJob(folder, CAMERA, None, (A, B), settings)
    first = examine_frame(job, FRAME_INPUT)
    return first, examine_frame_again(job, GuidedInput(FRAME_INPUT, first, expected))


def test_a_target_found_again_does_not_explain_another_target_s_miss(folder: Path) -> None:
    first, second = look_twice(folder, {"A": PREDICTION})
    assert all(isinstance(one, Miss) and one.candidates == 2 for one in first.outcomes)
    found, missed = second.outcomes
    assert isinstance(found, Measurement)
    assert found.is_guided
    assert found.common is not None
    assert isinstance(missed, Miss)
    assert missed.target == "B"
    assert missed.candidates == 1, "the decoy's ring, not that of A"
    assert replace(second, outcomes=first.outcomes) == first


def test_a_miss_is_explained_by_the_ring_at_the_expected_place(folder: Path) -> None:
    _, second = look_twice(folder, {"B": PREDICTION})
    _, missed = second.outcomes
    assert isinstance(missed, Miss)
    assert missed.reason is Reason.OTHER_CODE
    x, y = PREDICTION.centre_px
    assert missed.detail.startswith(f"ring at ({x:.0f}, {y:.0f}), radius 13.")


def test_the_first_reason_is_kept_if_nothing_is_at_the_predicted_place(folder: Path) -> None:
    away = replace(PREDICTION, centre_px=np.array([400.0, 60.0]))
    first, second = look_twice(folder, {"A": away, "B": away})
    assert second.outcomes == first.outcomes


def test_a_kept_frame_gives_the_same_result_and_is_not_decoded(
    folder: Path, tmp_path: Path
) -> None:
    _, decoded = look_twice(folder, {"A": PREDICTION})
    copy = tmp_path / "a.png"
    shutil.copy(folder / "a.png", copy)
    (tmp_path / "kept").mkdir()
    kept = KeptFrames(tmp_path / "kept", 1 << 20)
    job = DetectionJob(tmp_path, CAMERA, None, (A, B), STRICT, kept_frames=kept)
    first = examine_frame(job, FRAME_INPUT)
    copy.unlink()
    second = examine_frame_again(job, GuidedInput(FRAME_INPUT, first, {"A": PREDICTION}))
    assert to_text(second) == to_text(decoded)


def test_a_measured_target_is_left_as_it_is(folder: Path) -> None:
    first, second = look_twice(folder, {"B": PREDICTION}, DetectSettings())
    assert isinstance(first.outcomes[0], Measurement)
    assert second.outcomes[0] is first.outcomes[0]
    missed = second.outcomes[1]
    assert isinstance(missed, Miss)
    assert missed == first.outcomes[1], "the plate of A is not looked at for B"


def test_an_ellipse_s_centre_is_off_by_the_eccentricity(folder: Path) -> None:
    """Seen along the axis of the camera: ½ R² / f sin 2θ, towards the nearer side."""
    job = DetectionJob(folder, CAMERA, None, (A,), DetectSettings())
    (measured,) = examine_frame(job, FRAME_INPUT).outcomes
    assert isinstance(measured, Measurement)
    tilt_rad = 0.6
    tilted = Pose(rotation_about(np.array([0.0, tilt_rad, 0.0])), np.array([0.0, 0.0, 5.0]))
    (changed,) = completed(job, [replace(measured, pose=tilted)])
    assert isinstance(changed, Measurement)
    radius_px = CAMERA.fx * 0.45 / 5.0
    expected = 0.5 * radius_px**2 / CAMERA.fx * np.sin(2.0 * tilt_rad)
    assert changed.eccentricity_px is not None
    assert abs(changed.eccentricity_px[0]) == pytest.approx(expected, rel=0.02)
    assert changed.eccentricity_px[1] == pytest.approx(0.0, abs=1e-9)
    # depth along the plate's x axis is rotation[2, 0] < 0: its side at +x is the nearer one
    assert np.sign(changed.eccentricity_px[0]) == np.sign(-tilted.rotation[2, 0])


def test_outcomes_are_completed_together_as_one_by_one(folder: Path) -> None:
    job = DetectionJob(folder, CAMERA, None, (A, B), DetectSettings())
    measured, missed = examine_frame(job, FRAME_INPUT).outcomes
    assert isinstance(measured, Measurement)
    outcomes = [
        replace(measured, pose=measured.pose.tilted(tilt_rad)) for tilt_rad in (0.0, 0.2, 0.5)
    ]
    together = completed(job, [outcomes[0], missed, *outcomes[1:]])
    assert together[1] is missed
    for outcome, alone in zip([together[0], *together[2:]], outcomes, strict=True):
        (expected,) = completed(job, [alone])
        assert isinstance(outcome, Measurement)
        assert isinstance(expected, Measurement)
        assert outcome.pose is alone.pose
        assert outcome.eccentricity_px == pytest.approx(expected.eccentricity_px, abs=1e-11)


def test_the_known_motion_is_part_of_a_plain_target_s_prediction(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[SceneRotation | None] = []

    def look(*arguments: object) -> Miss:
        prediction = arguments[3]
        assert isinstance(prediction, PlainPrediction)
        seen.append(prediction.rotation)
        return Miss("W", Reason.NO_PREDICTION)

    monkeypatch.setattr("kgcp.pipeline.frame_task.measure_plain", look)
    rotation = SceneRotation((0.1, 0.0, 0.0), 0.01)
    plain = PlainTarget("W", (0.4,), PlainPolarity.BRIGHT, (0.0, 0.0, 0.0), border_m=0.4)
    where = PlainPrediction(
        np.array([200.0, 100.0]), np.eye(2), POSE.translation_m, 0.01, None, 9.0, "a test"
    )
    job = DetectionJob(folder, CAMERA, None, (A,), STRICT, plain_targets=(plain,))
    known = replace(FRAME_INPUT, priors={"W": PlatePrior(rotation=rotation)}, plain={"W": where})
    first = examine_frame(job, known)
    examine_frame_again(job, GuidedInput(known, first, {}, {"W": where}))
    examine_frame(job, replace(known, priors={}))
    assert seen == [rotation, rotation, None]


def test_one_disc_is_not_measured_for_two_plain_targets(tmp_path: Path) -> None:
    """One of two equal discs is hidden: the other one was measured for both, with full accuracy."""
    disc = PlainTarget("W1", (0.8,), PlainPolarity.BRIGHT, (0.0, 0.0, 0.0), border_m=0.4)
    discs = (disc, replace(disc, name="W2"))
    light = np.full((CAMERA.height, CAMERA.width), 0.3)
    image_plate(CAMERA, PlainPlate(disc), POSE, Optics(0.7)).paste(light)
    grey = Sensor().expose(light, 0.9, np.random.default_rng(1))
    assert cv2.imwrite(str(tmp_path / "a.png"), grey)
    plain = {
        each.name: PlainPrediction(
            CAMERA.project(POSE.translation_m[None])[0] + (off_px, 0.0),
            25.0 * np.eye(2),
            POSE.translation_m,
            0.01,
            NormalPrior(POSE.normal, 3.0),
            12.0,
            "a test",
        )
        for each, off_px in zip(discs, (1.0, 14.0), strict=True)
    }
    job = DetectionJob(tmp_path, CAMERA, None, (), STRICT, plain_targets=discs)
    at_once = examine_frame(job, replace(FRAME_INPUT, plain=plain))
    first = examine_frame(job, FRAME_INPUT)
    later = examine_frame_again(job, GuidedInput(FRAME_INPUT, first, {}, plain))
    for result in (at_once, later):
        assert [each.reason for each in result.outcomes if isinstance(each, Miss)] == [
            Reason.AMBIGUOUS_PLACE,
            Reason.AMBIGUOUS_PLACE,
        ]
    alone = examine_frame(job, replace(FRAME_INPUT, plain={"W1": plain["W1"]}))
    assert isinstance(alone.outcomes[0], Measurement)
