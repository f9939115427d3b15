"""Layouts that are hard to find, sizes in other units, and prints that are not as stated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.plate import SeenPrint, check_plates, check_print
from kgcp.targets.layout import Ring, Target

SEVEN_DEG = (0.0, 50.0, 102.0, 155.0, 206.0, 258.0, 311.0)


def target(outer_m: float = 0.9, inner_ratio: float = 0.5, white_share: float = 0.1) -> Target:
    ring_m2 = (1.0 - inner_ratio**2) * outer_m**2
    dot_m = math.sqrt(white_share * ring_m2 / len(SEVEN_DEG))
    code_m = 0.5 * (1.0 + inner_ratio) * outer_m
    return Target(Ring("A", outer_m, inner_ratio * outer_m, code_m, dot_m, SEVEN_DEG))


@pytest.mark.parametrize(
    ("inner_ratio", "white_share", "words"),
    [
        (0.5, 0.1, ""),
        (0.4, 0.1, ""),
        (0.38, 0.1, "is 0.38 times the outer one; outside 0.4 to 0.7, many rings are not found"),
        (0.7, 0.1, ""),
        (0.72, 0.1, "is 0.72 times the outer one"),
        (0.5, 0.32, ""),
        (0.5, 0.35, "the dots of 'A' cover 35% of the ring; many such rings are not found"),
    ],
)
def test_layouts_that_are_hard_to_find_are_reported(
    inner_ratio: float, white_share: float, words: str
) -> None:
    doubts = [*check_plates([target(inner_ratio=inner_ratio, white_share=white_share)])]
    assert [doubt.code for doubt in doubts] == [Cause.LAYOUT] * bool(words)
    assert all(words in doubt.sentence and not doubt.is_grave for doubt in doubts)


@pytest.mark.parametrize(
    ("outer_m", "words"),
    [
        (0.03, ""),
        (7.0, ""),
        (0.01, "an outer diameter of 0.01 m"),
        (24.0, "24 m (0.61 m if it is in inches, 0.24 m if it is in centimetres)"),
        (90.0, "90 m (2.29 m if it is in inches, 0.9 m if it is in centimetres)"),
    ],
)
def test_diameters_in_other_units_are_reported(outer_m: float, words: str) -> None:
    doubts = [*check_plates([target(outer_m)])]
    assert [doubt.code for doubt in doubts] == [Cause.DIAMETERS] * bool(words)
    assert all(words in doubt.sentence and doubt.is_grave for doubt in doubts)


CAMERA = Camera(1200, 900, 1900.0, 1900.0, 600.0, 450.0)


@pytest.mark.parametrize(
    ("growth", "edge_px", "frames", "words"),
    [
        (0.0, 0.0, 24, ""),
        (0.001, 0.0, 24, ""),  # negligible
        (0.010, 0.0, 24, "in 24 frames, the inner circle of 'A' is 1.0"),
        (-0.010, 0.0, 24, "% too small for the outer one"),
        (0.010, 0.0, 5, ""),  # too few
        (0.0, 0.05, 24, ""),  # the tone curve displaces edges, by as many pixels near and far
        (0.010, 0.05, 24, "% too large for the outer one"),
    ],
)
def test_an_inner_circle_that_is_not_as_stated_in_all_frames_is_reported(
    growth: float, edge_px: float, frames: int, words: str
) -> None:
    rng = np.random.default_rng(7)
    distances_m = np.geomspace(9.0, 50.0, frames)
    radii_px = 0.225 * CAMERA.mean_focal_px / distances_m
    seen = growth + edge_px / radii_px + 0.02 * radii_px**-1.5 * rng.standard_normal(frames)
    seen[2] = 0.2  # something hid the circle
    pairs = zip(distances_m.tolist(), seen.tolist(), strict=True)
    prints = [SeenPrint("A", distance_m, inner, None) for distance_m, inner in pairs]
    doubts = [*check_print(prints, [target()], CAMERA)]
    assert [doubt.code for doubt in doubts] == [Cause.DIAMETERS] * bool(words)
    for doubt in doubts:
        assert words in doubt.sentence
        assert not doubt.is_grave
        assert doubt.figures["growth"] == pytest.approx(growth, abs=0.001)


@pytest.mark.parametrize(
    ("inner", "dots", "words"),
    [
        (0.0, 0.001, ""),  # negligible
        (0.0, 0.01, "% too far out or too large for its ring"),
        (0.002, -0.01, "% too far in or too small for its ring"),
        (0.034, -0.0065, "the inner circle of 'A' is 3.4"),  # as if the dots were displaced, too
        (-0.0071, -0.0073, "the inner circle of 'A' is 0.7"),  # the outer diameter is wrong
    ],
)
def test_dots_that_are_not_as_stated_are_told_from_a_wrong_inner_circle(
    inner: float, dots: float, words: str
) -> None:
    rng = np.random.default_rng(7)
    distances_m = np.geomspace(9.0, 50.0, 24)
    noise = 0.02 * (0.3 * CAMERA.mean_focal_px / distances_m) ** -1.5
    seen = np.array([[inner], [dots]]) + noise * rng.standard_normal((2, 24))
    prints = [
        SeenPrint("A", *each) for each in zip(distances_m.tolist(), *seen.tolist(), strict=True)
    ]
    doubts = [*check_print(prints, [target()], CAMERA)]
    assert [doubt.code for doubt in doubts] == [Cause.DIAMETERS] * bool(words)
    assert all(words in doubt.sentence for doubt in doubts)
