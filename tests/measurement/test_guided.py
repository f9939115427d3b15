"""The second look finds what the first could not, and nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.measurement.guided import Prediction, measure_guided
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import Measurement, Miss
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]
SETTINGS = DetectSettings()
OTHER_CODES = ((0.0, 60.0, 150.0, 240.0), (0.0, 43.0, 130.0, 180.0), (0.0, 78.0, 200.0), (0.0,))


def expected_at(
    x: float, y: float, radius_px: float, sd_px: float = 2.0, sd_log_radius: float = 0.04
) -> Prediction:
    return Prediction(np.array([x, y]), sd_px, radius_px, sd_log_radius, "a test")


def look(
    grey: GreyArray, camera: Camera, target: Target, prediction: Prediction
) -> Measurement | None:
    return measure_guided(grey, camera, target, prediction, SETTINGS, PlatePrior(), ())[0]


@pytest.mark.parametrize(
    ("radius_px", "light"),
    [(5.0, {"ground": 0.75}), (14.0, {"black": 0.28, "white": 0.31, "noise": 0.002})],
    ids=["tiny", "faint"],
)
def test_a_missed_target_is_found_at_its_predicted_place(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    radius_px: float,
    light: dict[str, float],
) -> None:
    pose = place_plate((201.3, 150.8), radius_px, tilt_deg=12.0, way_deg=50.0, turn_deg=20.0)
    grey = draw_frame((target, pose), **light)
    (first,) = measure_frame(grey, camera, (target,), SETTINGS)
    assert isinstance(first, Miss)
    seen = look(grey, camera, target, expected_at(204.0, 148.0, 1.02 * radius_px))
    assert seen is not None
    assert seen.is_guided
    assert np.linalg.norm(seen.centre_px - camera.project(pose.translation_m)) < 0.1
    assert seen.pose.distance_m == pytest.approx(pose.distance_m, rel=0.02)


def test_the_score_may_be_slightly_lower_at_a_predicted_place(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    least = []

    def refuse(*arguments: object) -> Measurement:
        (settings,) = (each for each in arguments if isinstance(each, DetectSettings))
        least.append(settings.min_score)
        raise Rejection(Reason.CODE_MISMATCH)

    monkeypatch.setattr("kgcp.measurement.guided.measure_match", refuse)
    grey = draw_frame((target, place_plate((201.0, 150.0), 12.0, turn_deg=20.0)))
    assert look(grey, camera, target, expected_at(201.0, 150.0, 12.0)) is None
    assert least
    assert all(0.02 < SETTINGS.min_score - score < 0.1 for score in least)


@pytest.mark.parametrize(
    "expectation",
    [
        expected_at(188.0, 150.0, 12.0, sd_px=3.0),
        expected_at(200.0, 150.0, 15.0, sd_log_radius=0.04),
        expected_at(200.0, 150.0, 9.5, sd_log_radius=0.04),
    ],
    ids=["elsewhere", "too small", "too large"],
)
def test_a_target_away_from_its_prediction_is_refused(
    target: Target,
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    expectation: Prediction,
) -> None:
    grey = draw_frame((target, place_plate((201.0, 150.0), 12.0, turn_deg=20.0)))
    assert look(grey, camera, target, expectation) is None
    assert look(grey, camera, target, expected_at(200.0, 150.0, 12.3)) is not None


def test_the_rest_of_the_frame_does_not_matter(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    grey = draw_frame(
        (target, place_plate((340.0, 200.0), 9.0)), (target, place_plate((200.0, 150.0), 9.0))
    )
    seen = look(grey, camera, target, expected_at(199.0, 151.0, 9.2))
    assert seen is not None
    assert np.linalg.norm(seen.centre_px - (200.0, 150.0)) < 0.5


def test_decoys_at_the_predicted_place_are_refused(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    """Plates of the same geometry with another code, small, tilted and noisy."""
    rng = np.random.default_rng(4)
    taken = []
    for trial in range(40):
        code = OTHER_CODES[trial % len(OTHER_CODES)]
        decoy = Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, code))
        radius = rng.uniform(4.5, 14.0)
        pose = place_plate(
            tuple(rng.uniform((195.0, 145.0), (205.0, 155.0))),
            radius,
            tilt_deg=rng.uniform(0.0, 40.0),
            way_deg=rng.uniform(0.0, 360.0),
            turn_deg=rng.uniform(0.0, 360.0),
        )
        grey = draw_frame(
            (decoy, pose), blur_px=rng.uniform(0.6, 1.6), noise=rng.uniform(0.005, 0.03), seed=trial
        )
        if look(grey, camera, target, expected_at(200.0, 150.0, radius, sd_px=3.0)) is not None:
            taken.append((trial, code, radius))
    assert taken == []


def test_noise_and_edges_are_not_taken_for_a_target(target: Target, camera: Camera) -> None:
    rng = np.random.default_rng(6)
    taken = 0
    for _ in range(8):
        coarse = rng.normal(120.0, 60.0, (camera.height // 6, camera.width // 6))
        grey = np.kron(coarse, np.ones((6, 6))) + rng.normal(
            0.0, 8.0, (camera.height, camera.width)
        )
        frame = np.clip(grey, 0.0, 255.0).astype(np.uint8)
        wanted = expected_at(200.0, 150.0, float(rng.uniform(4.0, 30.0)), sd_px=6.0)
        taken += look(frame, camera, target, wanted) is not None
    assert taken == 0


def test_plates_of_other_targets_are_not_examined(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    grey = draw_frame((target, place_plate((200.0, 150.0), 12.0)))
    (rival,) = measure_frame(grey, camera, (target,), SETTINGS)
    assert isinstance(rival, Measurement)
    wanted = expected_at(200.0, 150.0, 12.0)
    assert measure_guided(grey, camera, target, wanted, SETTINGS, PlatePrior(), (rival,)) == (
        None,
        (),
    )


def test_examined_rings_have_the_reason_of_their_rejection(
    target: Target, camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    decoy = Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, OTHER_CODES[0]))
    grey = draw_frame((decoy, place_plate((200.0, 150.0), 12.0)))
    wanted = expected_at(200.0, 150.0, 12.0)
    seen, considered = measure_guided(grey, camera, target, wanted, SETTINGS, PlatePrior(), ())
    assert seen is None
    assert considered[0].reason is Reason.OTHER_CODE


@pytest.mark.parametrize(
    ("expectation", "is_visible", "is_sure"),
    [
        (expected_at(200.0, 150.0, 12.0), True, True),
        (expected_at(-3.0, 150.0, 12.0), False, True),
        (expected_at(200.0, 361.0, 12.0), False, True),
        (expected_at(200.0, 150.0, 2.0, sd_px=1.0), False, True),
        (expected_at(200.0, 150.0, 12.0, sd_px=40.0), True, False),
        (expected_at(200.0, 150.0, 12.0, sd_log_radius=0.5), True, False),
    ],
)
def test_visible_and_certain_predictions_are_recognised(
    camera: Camera, expectation: Prediction, *, is_visible: bool, is_sure: bool
) -> None:
    assert (expectation.is_visible(camera), expectation.is_sure) == (is_visible, is_sure)
