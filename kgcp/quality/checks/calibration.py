"""Check of a camera's parameters: whether they can be those of a frame camera, in pixels."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import counted

# Credible focal lengths: the least over the longer side of the frame, which is a field of view of
# 136°, beyond lenses of this distortion model; the largest over the shorter side, a lens of 1000 mm
# on small format.
_MIN_FOCAL_RATIO = 0.2
_MAX_FOCAL_RATIO = 30.0
_MIDDLE_THIRD = 1.0 / 3.0, 2.0 / 3.0
_MIN_ASPECT = 0.9  # of pixels; no sensor has less square ones
_MAX_OFF_CENTRE = 0.12  # of a principal point, in frame sizes


class CalibrationGrade(StrEnum):
    """What a calibration may be used for: the verdict of `kgcp calibrate`."""

    GOOD = "good"
    LOOK = "to be checked"
    UNUSABLE = "unusable"


def check_camera(
    camera: Camera, *, is_guessed: bool = False, grade: CalibrationGrade | None = None
) -> Iterator[Doubt]:
    """Yield doubts about focal lengths, principal points, distortions, guesses, and verdicts."""
    yield from _check_focal_length(camera)
    yield from _check_principal_point(camera)
    yield from _check_corners(camera)
    yield from _check_rows(camera)
    if is_guessed:
        yield mild(
            Cause.GUESSED_CAMERA,
            f"the camera is a guess from EXIF (fx = {camera.fx:g} px), not a calibration: distances"
            " may be wrong by several per cent",
            "give a calibration under [camera], and delete guessed and the sd_ keys of the guess",
            {"fx_px": camera.fx},
        )
    if grade is CalibrationGrade.UNUSABLE:
        yield grave(
            Cause.CALIBRATION_VERDICT,
            "the verdict of 'kgcp calibrate' on the camera is that it is unusable",
            "calibrate it again, by the advice in calibration.html",
        )
    elif grade is CalibrationGrade.LOOK:
        yield mild(
            Cause.CALIBRATION_VERDICT,
            "the verdict of 'kgcp calibrate' on the camera is that it is to be checked",
            "read the reasons in calibration.html, and calibrate it again; if they do not matter,"
            " delete verdict in camera.toml",
        )


def _check_rows(camera: Camera) -> Iterator[Doubt]:
    """Yield the doubt about a rolling shutter whose rows seem to be the frames' columns."""
    if camera.readout_s and camera.height > camera.width:
        yield mild(
            Cause.READOUT,
            f"frames of {camera.width} x {camera.height} px are higher than wide, but sensors have"
            " rows along their longer side, which readout_s needs: a program may have turned them",
            "give the frames as the camera stored them (kgcp ignores the orientation in EXIF, so"
            " that they may look turned), with their calibration; otherwise delete readout_s",
            {"width_px": float(camera.width), "height_px": float(camera.height)},
        )


def _check_focal_length(camera: Camera) -> Iterator[Doubt]:
    share = min(camera.fx, camera.fy) / max(camera.width, camera.height)
    figures = {"fx_px": camera.fx, "fy_px": camera.fy}
    if share < _MIN_FOCAL_RATIO:
        yield grave(
            Cause.FOCAL_LENGTH,
            f"fx = {camera.fx:g}, fy = {camera.fy:g} px are too short for frames of"
            f" {camera.width} px: are they in millimetres?",
            "divide the focal length in mm by the size of a pixel in mm",
            figures,
        )
    elif max(camera.fx, camera.fy) / min(camera.width, camera.height) > _MAX_FOCAL_RATIO:
        yield grave(
            Cause.FOCAL_LENGTH,
            f"fx = {camera.fx:g}, fy = {camera.fy:g} px are too long for frames of"
            f" {camera.width} px: are they in micrometres?",
            "give the focal length in pixels",
            figures,
        )
    elif min(camera.fx, camera.fy) < _MIN_ASPECT * max(camera.fx, camera.fy):
        yield mild(
            Cause.FOCAL_LENGTH,
            f"fx = {camera.fx:g} and fy = {camera.fy:g} px differ by more than those of any sensor"
            " with square pixels",
            "look both up in the calibration",
            figures,
        )


def _check_principal_point(camera: Camera) -> Iterator[Doubt]:
    low, high = _MIDDLE_THIRD
    x, y = camera.cx / camera.width, camera.cy / camera.height
    if low <= x <= high and low <= y <= high:
        return
    figures = {"cx_px": camera.cx, "cy_px": camera.cy}
    sentence = (
        f"the principal point ({camera.cx:g}, {camera.cy:g}) px is not in the middle third of a"
        f" frame of {camera.width} x {camera.height} px"
    )
    for scale, word in ((2.0, "double"), (0.5, "half"), (4.0, "four times the"), (0.25, "quarter")):
        if max(abs(x / scale - 0.5), abs(y / scale - 0.5)) < _MAX_OFF_CENTRE:
            yield grave(
                Cause.CALIBRATION_SIZE,
                f"{sentence}, but in the middle of one of {word} size",
                "give the calibration of frames of this size, or scale fx, fy, cx, cy by"
                f" {1.0 / scale:g}",
                {**figures, "scale": scale},
            )
            return
    is_exchanged = all(
        abs(value - 0.5) < _MAX_OFF_CENTRE
        for value in (camera.cy / camera.width, camera.cx / camera.height)
    )
    if is_exchanged:
        remedy = "exchange cx and cy, or width and height, in [camera]"
    elif max(abs(camera.cx), abs(camera.cy)) < 0.05 * camera.width:
        remedy = (
            "give it in pixels from the centre of the top-left pixel: divide offsets from the"
            " frame's centre in mm by the size of a pixel, and add half the frame's size"
        )
    else:
        remedy = "look cx and cy up in the calibration, in pixels from the top-left pixel"
    yield grave(Cause.PRINCIPAL_POINT, sentence, remedy, figures)


def _check_corners(camera: Camera) -> Iterator[Doubt]:
    """Yield the doubt about a distortion that ends inside the frame."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    count = int(np.count_nonzero(np.isnan(camera.undistort(corners)).any(axis=1)))
    if count:
        yield mild(
            Cause.DISTORTION,
            f"the distortion k1 = {camera.k1:g}, k2 = {camera.k2:g} … folds back inside the frame:"
            f" {counted(count, 'corner')} of the frame cannot be seen through such a lens, and"
            " distances are wrong towards the corners",
            "look the coefficients up in the calibration, or calibrate with points in the corners",
            {"corners": float(count)},
        )
