from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.search.candidates import find_code, find_dotted_rings, find_rings
from kgcp.measurement.search.code_signal import (
    CODE_ANGLES_RAD,
    fixed_lag_score,
    match_code,
    reference_signals,
)
from kgcp.measurement.search.sampling import sample_grey
from kgcp.measurement.search.template_match import match_templates
from kgcp.measurement.search.templates import ANGLES_RAD, SAMPLED_RADII
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

CODE_RATIO = 0.642857143 / 0.9

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]


def turned_signal(ring: Ring, turn_deg: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.roll(reference_signals(ring)[1], turn_deg)


@pytest.mark.parametrize("turn_deg", [0, 1, 77, 180, 359])
def test_the_lag_is_the_heading_of_the_plate(target: Target, turn_deg: int) -> None:
    scores, lags = match_code(40.0 + 90.0 * turned_signal(target.ring, turn_deg)[None], target.ring)
    assert scores[0] == pytest.approx(1.0, abs=1e-9)
    assert (lags[0] - turn_deg + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.1)


def test_the_score_does_not_depend_on_exposure_and_falls_for_the_negative(target: Target) -> None:
    signal = turned_signal(target.ring, 20)
    scores, _ = match_code(np.stack((signal, 5.0 + 0.1 * signal, -signal)), target.ring)
    assert scores[0] == pytest.approx(scores[1])
    assert scores[2] < 0.5


def test_a_flat_signal_matches_nothing(target: Target) -> None:
    scores, _ = match_code(np.full((1, 360), 7.0), target.ring)
    assert scores[0] == 0.0


def test_the_signal_follows_the_ellipse_of_a_tilted_plate(
    target: Target,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    camera: Camera,
) -> None:
    pose = place_plate((250.0, 170.0), 50.0, tilt_deg=40.0, way_deg=25.0, turn_deg=30.0)
    frame = draw_frame((target, pose))
    x, y = camera.project(pose.translation_m)
    short = math.cos(math.radians(40.0))
    ellipse = Ellipse(float(x), float(y), 50.0, 50.0 * short, math.radians(25.0))
    scores, _ = match_code(
        sample_grey(frame, ellipse.points(CODE_ANGLES_RAD, CODE_RATIO)[None]), target.ring
    )
    assert scores[0] > 0.97
    circle = Ellipse(ellipse.x, ellipse.y, 44.0, 44.0, 0.0)
    scores, _ = match_code(
        sample_grey(frame, circle.points(CODE_ANGLES_RAD, CODE_RATIO)[None]), target.ring
    )
    assert scores[0] < 0.9


@pytest.mark.parametrize("radius_px", [10.0, 14.0, 30.0])
@pytest.mark.parametrize(
    "other_code",
    [(0.0, 43.0, 78.0, 205.0), (0.0, 43.0, 110.0, 180.0), (0.0, 43.0, 78.0, 180.0, 260.0)],
    ids=["one dot moved", "another dot moved", "one dot more"],
)
def test_a_similar_code_of_the_same_geometry_is_another_target(
    target: Target,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    radius_px: float,
    other_code: tuple[float, ...],
) -> None:
    ring = target.ring
    other = Target(Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, other_code))
    outer = Ellipse(250.0, 170.0, radius_px, radius_px, 0.0)
    for plate, expected in ((target, 1), (other, 0)):
        pose = place_plate((250.0, 170.0), radius_px, turn_deg=100.0)
        frame = draw_frame((plate, pose))
        candidates = find_dotted_rings(frame, (outer,), [ring])
        matches, refused = find_code(candidates[ring], ring, DetectSettings())
        assert len(matches) == expected
        assert [refusal.reason for refusal in refused] == [Reason.OTHER_CODE][expected:]


def test_a_code_without_a_ring_around_it_is_refused(target: Target) -> None:
    """Dots of the right pattern on plain dark ground: no white plate, no target."""
    outer = Ellipse(100.0, 100.0, 40.0, 40.0, 0.0)
    frame = np.full((200, 200), 20, dtype=np.uint8)
    rows, columns = np.indices(frame.shape)
    for angle in np.radians(target.ring.code_deg):
        x, y = 100.0 + 40.0 * CODE_RATIO * np.array([math.cos(angle), math.sin(angle)])
        frame[np.hypot(columns - x, rows - y) < 5.7] = 200
    signal = sample_grey(frame, outer.points(CODE_ANGLES_RAD, CODE_RATIO)[None])
    assert match_code(signal, target.ring)[0][0] > 0.95
    assert find_dotted_rings(frame, (outer,), target.rings) == {
        target.ring: (),
        target.replicas[0]: (),
    }
    patch = np.stack([outer.points(ANGLES_RAD, radius) for radius in SAMPLED_RADII])
    template_match = match_templates(sample_grey(frame, patch), target.ring, 40.0)
    with pytest.raises(Rejection):
        template_match.check(DetectSettings().min_score)


def test_shade_is_accepted_and_unrelated_light_on_disc_and_plate_is_not(
    target: Target, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    outer = Ellipse(250.0, 170.0, 40.0, 40.0, 0.0)
    plate = draw_frame((target, place_plate((250.0, 170.0), 40.0, turn_deg=100.0)))
    rows, columns = np.indices(plate.shape)
    shade = np.where(columns > 240 + 0.3 * (rows - 170), 0.3, 1.0)
    inside = np.hypot(columns - 250, rows - 170) < 25
    crossing = np.where(inside, (rows - 170) / 16, (columns - 250) / 44)  # no light does that
    for light, expected in ((shade, 1), (np.clip(0.67 + 0.33 * crossing, 0.0, 1.0), 0)):
        frame = np.rint(plate * light).astype(np.uint8)
        assert len(find_dotted_rings(frame, (outer,), [target.ring])[target.ring]) == expected
    found = find_rings(np.rint(plate * shade).astype(np.uint8), DetectSettings())
    assert any(math.dist((ring.x, ring.y, ring.a), (250.0, 170.0, 40.0)) < 2.0 for ring in found)


def test_fixed_lag_score_compares_the_visible_code_at_its_heading(
    target: Target,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
) -> None:
    frame = draw_frame((target, place_plate((250.0, 170.0), 40.0)))
    circle = np.stack((np.cos(CODE_ANGLES_RAD), np.sin(CODE_ANGLES_RAD)), axis=-1)
    points = np.array([250.0, 170.0]) + 40.0 * CODE_RATIO * circle
    half = np.arange(360) < 200
    assert fixed_lag_score(frame, points, half, target.ring) > 0.9
    assert fixed_lag_score(frame, np.roll(points, 60, axis=0), half, target.ring) < 0.5
