from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from kgcp.geometry.camera import Camera
from kgcp.quality.checks.calibration import CalibrationGrade, check_camera
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.plate import check_plates
from kgcp.targets.layout import Ring, Target

CAMERA = Camera(1200, 900, 1903.0, 1901.0, 606.2, 446.1)


def test_cameras_in_pixels_raise_no_doubt() -> None:
    wide = replace(CAMERA, fx=700.0, fy=700.0)
    tele = replace(CAMERA, fx=15_000.0, fy=15_000.0)
    barrel = replace(wide, k1=-0.3, k2=0.12, k3=-0.02)
    for camera in (CAMERA, wide, tele, barrel, CAMERA.binned(4)):
        assert not [*check_camera(camera)]


def test_frames_turned_by_90_degrees_have_no_rows_to_read() -> None:
    turned = replace(CAMERA, width=900, height=1200, cx=446.1, cy=606.2)
    assert not [*check_camera(turned)]
    assert not [*check_camera(replace(CAMERA, readout_s=0.03))]
    (doubt,) = check_camera(replace(turned, readout_s=0.03))
    assert doubt.code is Cause.READOUT
    assert "as the camera stored them" in doubt.remedy


@pytest.mark.parametrize(
    ("numbers", "code", "words"),
    [
        ({"fx": 8.8, "fy": 8.8}, Cause.FOCAL_LENGTH, "are they in millimetres?"),
        ({"fx": 8800.0 * 6, "fy": 8800.0 * 6}, Cause.FOCAL_LENGTH, "are they in micrometres?"),
        ({"fy": 1091.0}, Cause.FOCAL_LENGTH, "any sensor with square pixels"),
        ({"cx": 6.2, "cy": -4.1}, Cause.PRINCIPAL_POINT, "in mm by the size of a pixel"),
        ({"cx": 0.0, "cy": 0.0}, Cause.PRINCIPAL_POINT, "half the frame's size"),
        ({"cx": 1212.4, "cy": 892.2}, Cause.CALIBRATION_SIZE, "of double size"),
        ({"cx": 303.0, "cy": 223.0}, Cause.CALIBRATION_SIZE, "of half size"),
        ({"k1": -1.2}, Cause.DISTORTION, "4 corners of the frame cannot be seen"),
        ({"k1": -0.9, "cx": 680.0}, Cause.DISTORTION, "2 corners of the frame cannot be seen"),
        ({"cx": 650.0, "cy": 700.0}, Cause.PRINCIPAL_POINT, "look cx and cy up"),
    ],
)
def test_other_units_and_sizes_are_named(numbers: dict[str, Any], code: Cause, words: str) -> None:
    (doubt,) = check_camera(replace(CAMERA, **numbers))
    assert doubt.code is code
    assert words in str(doubt)


def test_a_calibration_of_upright_frames_is_reported() -> None:
    (doubt,) = check_camera(Camera(900, 1350, 1903.0, 1903.0, 672.0, 440.0))
    assert "exchange cx and cy" in doubt.remedy


@pytest.mark.parametrize(
    ("diameter", "words"),
    [(35.4, "0.899 m if it is in inches"), (90.0, "0.9 m if it is in centimetres"), (0.009, "")],
)
def test_diameters_in_other_units_are_reported(diameter: float, words: str) -> None:
    ring = Ring("A", diameter, diameter / 2, diameter / 1.4, diameter / 7, (0.0, 43.0))
    (doubt,) = check_plates([Target(ring)])
    assert doubt.code is Cause.DIAMETERS
    assert words in doubt.sentence


@pytest.mark.parametrize(
    ("ratio", "dot_share", "dots", "words"),
    [
        (0.39, 0.5, 4, "is 0.39 times the outer one"),
        (0.71, 0.5, 4, "is 0.71 times the outer one"),
        (0.4, 0.73, 6, "cover 34% of the ring"),
        (0.4, 0.7, 6, ""),
        (0.4, 0.57, 6, ""),
        (0.67, 0.22, 6, "the dots of 'A' are 5.0° wide, seen from the centre; below 8°"),
        (0.6, 0.27, 4, "are 7.7° wide"),
        (0.6, 0.29, 4, ""),
        (0.5, 0.57, 4, ""),
        (0.7, 0.57, 6, ""),
    ],
)
def test_layouts_that_the_search_cannot_find_are_reported(
    ratio: float, dot_share: float, dots: int, words: str
) -> None:
    code_deg = tuple(60.0 * k + k for k in range(dots))
    ring = Ring("A", 0.9, 0.9 * ratio, 0.45 * (1 + ratio), 0.45 * dot_share * (1 - ratio), code_deg)
    doubts = [*check_plates([Target(ring)])]
    assert [doubt.code for doubt in doubts] == ([Cause.LAYOUT] if words else [])
    assert all(words in doubt.sentence for doubt in doubts)


@pytest.mark.parametrize("diameter", [0.05, 0.3, 0.9, 3.0])
def test_usual_diameters_raise_no_doubt(diameter: float) -> None:
    ring = Ring("A", diameter, diameter / 2, diameter / 1.4, diameter / 7, (0.0, 43.0))
    assert not [*check_plates([Target(ring)])]


def test_only_a_good_verdict_raises_no_doubt() -> None:
    assert not [*check_camera(CAMERA, grade=CalibrationGrade.GOOD)]
    (mild,) = check_camera(CAMERA, grade=CalibrationGrade.LOOK)
    (grave,) = check_camera(CAMERA, grade=CalibrationGrade.UNUSABLE)
    assert [mild.is_grave, grave.is_grave] == [False, True]
    assert mild.code == grave.code == Cause.CALIBRATION_VERDICT
