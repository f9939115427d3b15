"""Dots of any code are read, and assigned to the ring that has this code."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import Reason
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import Miss
from kgcp.measurement.search.dot_reading import align_dots, describe_dots, read_dots
from kgcp.pipeline.measure import measure_frame
from kgcp.targets.layout import Ring, Target

PlacePlate = Callable[..., Pose]
DrawFrame = Callable[..., GreyArray]
RING = Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0))
HALF_DEG = RING.dot_half_angle_deg
MIRRORED = (0.0, 180.0, 282.0, 317.0)
INNER = (10.0, 80.0, 150.0, 250.0, 290.0)


def coded(code_deg: tuple[float, ...], name: str = "A") -> Target:
    return Target(replace(RING, name=name, code_deg=code_deg))


def whole(code_deg: tuple[float, ...]) -> Target:
    """A plate whose replica carries another code than the main ring."""
    return Target(replace(RING, code_deg=code_deg), (RING.scaled("A-inner", 0.2, INNER),))


@given(
    turn_deg=st.floats(0.0, 360.0),
    noise_deg=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
)
def test_a_code_is_recognised_at_any_heading(turn_deg: float, noise_deg: list[float]) -> None:
    dots = np.sort((np.array(RING.code_deg) + noise_deg + turn_deg) % 360.0)
    assert align_dots(dots, RING.code_deg, HALF_DEG).is_code
    assert not align_dots(dots, MIRRORED, HALF_DEG).is_code
    assert not align_dots(dots, (0.0, 50.0, 78.0, 180.0), HALF_DEG).is_code
    assert not align_dots(dots[1:], RING.code_deg, HALF_DEG).is_code


@pytest.mark.parametrize("radius_px", [11.0, 20.0, 60.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
@pytest.mark.parametrize(
    "code_deg",
    [(0.0, 43.0, 78.0, 215.0), (0.0, 43.0, 180.0), (0.0, 43.0, 78.0, 180.0, 260.0), MIRRORED],
)
def test_a_wrong_code_is_read_from_the_frame(
    camera: Camera,
    place_plate: PlacePlate,
    draw_frame: DrawFrame,
    code_deg: tuple[float, ...],
    tilt_deg: float,
    radius_px: float,
) -> None:
    pose = place_plate((240.0, 180.0), radius_px, tilt_deg=tilt_deg, way_deg=30.0, turn_deg=-70.0)
    frame = draw_frame((coded(code_deg), pose))
    (miss,) = measure_frame(frame, camera, [Target(RING)])
    assert isinstance(miss, Miss)
    assert miss.reason is Reason.OTHER_CODE
    read = re.search(r"dots at ([\d, ]+) deg, flight.toml has 0, 43, 78, 180 for A", miss.detail)
    assert read, miss.detail
    dots = np.array([float(angle) for angle in read[1].split(", ")])
    assert align_dots(dots, code_deg, HALF_DEG).is_code, miss.detail
    assert ("these are its mirror image" in miss.detail) == (code_deg is MIRRORED)


def test_closely_spaced_dots_are_read(
    camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    many = tuple(360.0 / 11.0 * number for number in range(11))
    pose = place_plate((240.0, 180.0), 50.0)
    frame = draw_frame((coded(many), pose))
    (x, y), radius_px = camera.project(pose.translation_m), 50.0
    dots = read_dots(frame, Ellipse(x, y, radius_px, radius_px, 0.0), RING)
    assert len(dots) == len(many)
    np.testing.assert_allclose(np.diff(dots), 360.0 / 11.0, atol=1.5)


def test_dirt_darker_than_the_ink_does_not_hide_the_dots(
    camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    """In haze, ink is nearer to the grey value of dots than to black."""
    radius_px = 50.0
    pose = place_plate((240.0, 180.0), radius_px)
    frame = (150.0 + draw_frame((coded(RING.code_deg), pose)) * (70.0 / 255.0)).astype(np.uint8)
    x, y = camera.project(pose.translation_m)
    ellipse = Ellipse(x, y, radius_px, radius_px, 0.0)
    clean = read_dots(frame, ellipse, RING)
    assert len(clean) == len(RING.code_deg)
    between = 0.5 * (clean[0] + clean[1]) if clean[1] - clean[0] > 40.0 else clean[1] + 20.0
    dirt = ellipse.points(np.radians([between]), RING.code_diameter_m / RING.outer_diameter_m)[0]
    cv2.circle(frame, np.rint(dirt).astype(int).tolist(), 4, 0, -1)
    np.testing.assert_allclose(read_dots(frame, ellipse, RING), clean, atol=1.0)


def test_the_main_ring_is_described_and_not_its_replica(
    camera: Camera, place_plate: PlacePlate, draw_frame: DrawFrame
) -> None:
    frame = draw_frame((whole((0.0, 50.0, 78.0, 180.0)), place_plate((240.0, 180.0), 90.0)))
    (miss,) = measure_frame(frame, camera, [whole(RING.code_deg)])
    assert isinstance(miss, Miss)
    assert miss.outline is not None
    assert miss.outline.a == pytest.approx(90.0, rel=0.02)
    assert "dots at 0, 50, 78, 180 deg, flight.toml has 0, 43, 78, 180 for A" in miss.detail


def test_dots_of_another_ring_of_the_flight_are_recognised() -> None:
    target, other = whole(RING.code_deg), coded((0.0, 90.0, 130.0, 220.0), "B")
    for code_deg, text in (
        (INNER, "for A: these are those of its replica A-inner"),
        (other.ring.code_deg, "for A: these are those of target B"),
    ):
        dots = (np.array(code_deg) + 33.0) % 360.0
        described = describe_dots(np.sort(dots), target.ring, target, (target, other))
        assert described is not None
        assert described.endswith(text)


def test_expected_dots_no_dots_and_textures_are_not_described() -> None:
    target = whole(RING.code_deg)
    for dots in (np.array(RING.code_deg), np.empty(0), np.arange(0.0, 360.0, 30.0)):
        assert describe_dots(dots, target.ring, target, (target,)) is None
