from __future__ import annotations

from dataclasses import replace

import pytest

from kgcp.geometry.camera import Camera
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.frame_header import FrameHeader, check_frames

CAMERA = Camera(4000, 3000, 2900.0, 2900.0, 2010.0, 1490.0)
DJI = [FrameHeader(f"{number}.jpg", (4000, 3000), "DJI FC300S", 3.61, 26.0) for number in range(20)]


def test_frames_of_the_camera_raise_no_doubt() -> None:
    assert not [*check_frames(DJI, CAMERA)]
    assert not [*check_frames([FrameHeader("a.png", (4000, 3000))], CAMERA)]
    assert not [*check_frames([FrameHeader("damaged.jpg")], CAMERA)]


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((3000, 4000), "of frames that were turned by 90°"),
        ((2000, 1500), "is of frames 2 times as large"),
        ((3000, 3000), "give the calibration of these frames"),
    ],
)
def test_frames_of_another_size_are_counted(size: tuple[int, int], words: str) -> None:
    (doubt,) = check_frames([replace(header, size_px=size) for header in DJI], CAMERA)
    assert (doubt.code, doubt.is_grave) == (Cause.FRAME_SIZE, True)
    assert "20 of 20 frames are not 4000 x 3000 px" in doubt.sentence
    assert words in doubt.remedy


def test_exchanged_width_and_height_are_told_from_a_turned_calibration() -> None:
    (doubt,) = check_frames(DJI, replace(CAMERA, width=3000, height=4000))
    assert doubt.remedy.startswith("exchange width and height in [camera], since cx and cy")


def test_a_single_frame_of_another_size_raises_no_grave_doubt() -> None:
    (doubt,) = check_frames([*DJI, FrameHeader("logo.png", (64, 64))], CAMERA)
    assert not doubt.is_grave
    assert "logo.png is 64 x 64 px" in doubt.sentence


def test_two_cameras_and_two_zooms_are_named() -> None:
    others = [replace(DJI[0], frame="b.jpg", camera="SONY ILCE-7RM4")]
    (doubt,) = check_frames([*DJI, *others], CAMERA)
    assert doubt.code is Cause.TWO_CAMERAS
    assert "1 from SONY ILCE-7RM4 with 3.61 mm, such as b.jpg" in doubt.sentence
    focused = [replace(DJI[0], frame="c.jpg", focal_mm=3.65)]
    assert not [*check_frames([*DJI, *focused], CAMERA)]
    zoomed = [replace(DJI[0], frame="c.jpg", focal_mm=7.2)]
    assert [one.code for one in check_frames([*DJI, *zoomed], CAMERA)] == [Cause.TWO_CAMERAS]


@pytest.mark.parametrize(
    ("factor", "code", "words"),
    [
        (2.0, Cause.CALIBRATION_SIZE, "double size"),
        (0.5, Cause.CALIBRATION_SIZE, "half size"),
        (1.5, Cause.FOCAL_LENGTH, "this camera and zoom"),
    ],
)
def test_a_focal_length_that_contradicts_exif_is_reported(
    factor: float, code: Cause, words: str
) -> None:
    wrong = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    (doubt,) = check_frames(DJI, wrong)
    assert doubt.code is code
    assert words in doubt.remedy
    assert doubt.figures["expected_fx_px"] == pytest.approx(2889.0, abs=1.0)


@pytest.mark.parametrize("focal_35_mm", [24.0, 29.0])
def test_focal_lengths_in_35_mm_equivalents_have_a_tolerance(focal_35_mm: float) -> None:
    assert not [*check_frames([replace(DJI[0], focal_35_mm=focal_35_mm)], CAMERA)]


@pytest.mark.parametrize(
    ("calibrated", "words"),
    [
        (ExifCamera("DJI FC6310", 3.61, 26.0), "are by DJI FC6310, but 20 of 20 frames are not"),
        (ExifCamera("", 3.61, 39.0), "by 39 mm (35 mm equivalent)"),
        (ExifCamera("DJI FC300S", 4.4), "0.jpg is by 3.61 mm"),
    ],
    ids=["another camera", "digital zoom or crop", "another zoom"],
)
def test_a_calibration_of_another_camera_is_reported(calibrated: ExifCamera, words: str) -> None:
    (doubt,) = check_frames(DJI, CAMERA, calibrated)
    assert (doubt.code, doubt.is_grave) == (Cause.OTHER_CAMERA, True)
    assert words in doubt.sentence


@pytest.mark.parametrize(
    "calibrated",
    [
        ExifCamera.shared_by([header.exif_camera for header in DJI]),
        ExifCamera("Dji FC300S 0123", 3.65, 27.0),  # frames without the serial number
        ExifCamera(),
    ],
)
def test_the_same_camera_raises_no_doubt(calibrated: ExifCamera) -> None:
    assert not [*check_frames(DJI, CAMERA, calibrated)]


def test_only_what_all_photographs_agree_on_is_stated() -> None:
    others = [FrameHeader("a.png"), FrameHeader("b.jpg", None, "DJI FC300S", 3.61, 52.0)]
    assert ExifCamera.shared_by([header.exif_camera for header in (*DJI, *others)]) == ExifCamera(
        "DJI FC300S", 3.61, None
    )
    assert ExifCamera.shared_by([ExifCamera("A\nB")]) == ExifCamera()
