"""Checks of the frames' headers against the camera: size, maker, focal length."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.measurement.exif_camera import FOCUS_FACTOR, ExifCamera
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild

_SMALL_FORMAT_MM = 36.0, math.hypot(36.0, 24.0)  # width and diagonal; equivalents refer to either
# Factor by which fx may differ from the 35 mm equivalent. Equivalents are rounded, refer to the
# width or the diagonal, and may be those of cropped video.
_FOCAL_TOLERANCE = 1.25
_SIZE_TOLERANCE = 1.1  # the same about half and double size


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """Data from the header of one frame; None: not in the header."""

    frame: str  # path relative to the frames folder
    size_px: tuple[int, int] | None = None  # width and height
    camera: str = ""  # maker, model and serial number; empty: not known
    focal_mm: float | None = None
    focal_35_mm: float | None = None  # of a small-format camera with the same angle of view
    focal_px: float | None = None  # from `focal_mm` and the resolution of the focal plane
    time_s: float | None = None  # Unix UTC, if the header states its time zone [s]
    # what the camera's clock showed, counted as Unix seconds count UTC, whatever its zone [s]
    clock_s: float | None = None
    # of the camera, WGS 84
    longitude_deg: float | None = None
    latitude_deg: float | None = None
    altitude_m: float | None = None  # above the take-off point

    @property
    def exif_camera(self) -> ExifCamera:
        """Camera and focal length."""
        return ExifCamera(self.camera, self.focal_mm, self.focal_35_mm)


def check_frames(
    headers: Sequence[FrameHeader], camera: Camera, calibrated: ExifCamera | None = None
) -> Iterator[Doubt]:
    """Compare sizes, makers and focal lengths of the frames with each other and the camera.

    Parameters
    ----------
    calibrated : ExifCamera, optional
        The camera by the photographs of its calibration.
    """
    yield from _check_sizes(headers, camera)
    yield from _check_cameras(headers)
    yield from _check_focal_length(headers, camera)
    yield from _check_calibrated(headers, calibrated or ExifCamera())


def _check_sizes(headers: Sequence[FrameHeader], camera: Camera) -> Iterator[Doubt]:
    sizes = Counter(header.size_px for header in headers if header.size_px is not None)
    wrong = sizes.total() - sizes[camera.width, camera.height]
    if not wrong:
        return
    (width, height), _ = next(
        item for item in sizes.most_common() if item[0] != (camera.width, camera.height)
    )
    name = next(header.frame for header in headers if header.size_px == (width, height))
    sentence = (
        f"{wrong} of {sizes.total()} frames are not {camera.width} x {camera.height} px, the"
        f" camera's size: {name} is {width} x {height} px"
    )
    figures = {"frames": float(wrong), "width_px": float(width), "height_px": float(height)}
    if (width, height) == (camera.height, camera.width):
        # the principal point is near the middle of the frames that it belongs to
        is_of_such_frames = (camera.cx > camera.cy) == (width > height)
        remedy = (
            "exchange width and height in [camera], since cx and cy are those of such frames"
            if is_of_such_frames
            else "give a calibration of frames as they are stored: that in flight.toml is of frames"
            " that were turned by 90°, and to exchange its values would not turn all of it; do not"
            " turn frames, because kgcp reads them as the sensor did"
        )
    elif abs(width / camera.width - height / camera.height) < 0.01 * width / camera.width:
        remedy = (
            "give the calibration of frames of this size; that in flight.toml is of frames"
            f" {camera.width / width:.4g} times as large"
        )
    else:
        remedy = "give the calibration of these frames, or remove frames of other cameras"
    doubt = grave if 10 * wrong > sizes.total() else mild
    yield doubt(Cause.FRAME_SIZE, sentence, remedy, figures)


def _check_cameras(headers: Sequence[FrameHeader]) -> Iterator[Doubt]:
    zooms = _zooms_mm(headers)
    cameras = Counter(
        (header.camera, None if header.focal_mm is None else zooms[header.focal_mm])
        for header in headers
        if header.camera or header.focal_mm is not None
    )
    if len(cameras) < 2:
        return
    (first, _), (second, count) = cameras.most_common(2)
    name = next(
        header.frame
        for header in headers
        if (header.camera, None if header.focal_mm is None else zooms[header.focal_mm]) == second
    )
    yield grave(
        Cause.TWO_CAMERAS,
        f"the frames are from {len(cameras)} cameras or focal lengths: most from {_named(first)},"
        f" but {count} from {_named(second)}, such as {name}",
        "make a flight folder of its own for each camera and zoom",
        {"cameras": float(len(cameras)), "frames": float(count)},
    )


def _zooms_mm(headers: Sequence[FrameHeader]) -> dict[float, float]:
    """Return, for each focal length, the smallest from which it differs by focusing only."""
    zooms: dict[float, float] = {}
    first = 0.0
    for focal_mm in sorted({header.focal_mm for header in headers if header.focal_mm is not None}):
        if focal_mm > FOCUS_FACTOR * first:
            first = focal_mm
        zooms[focal_mm] = first
    return zooms


def _named(camera: tuple[str, float | None]) -> str:
    name, focal_mm = camera
    return f"{name or 'an unnamed camera'}{'' if focal_mm is None else f' with {focal_mm:g} mm'}"


def _check_focal_length(headers: Sequence[FrameHeader], camera: Camera) -> Iterator[Doubt]:
    known = [header.focal_35_mm for header in headers if header.focal_35_mm is not None]
    if not known:
        return
    focal_35_mm = float(np.median(known))
    sizes = max(camera.width, camera.height), math.hypot(camera.width, camera.height)
    expected = [
        focal_35_mm / film * pixels for film, pixels in zip(_SMALL_FORMAT_MM, sizes, strict=True)
    ]
    ratio = camera.mean_focal_px / math.sqrt(expected[0] * expected[1])
    if 1.0 / _FOCAL_TOLERANCE < ratio < _FOCAL_TOLERANCE:
        return
    figures = {"exif_focal_35_mm": focal_35_mm, "expected_fx_px": expected[0], "ratio": ratio}
    sentence = (
        f"the frames' EXIF states a focal length of {focal_35_mm:g} mm (35 mm equivalent), which is"
        f" fx = {expected[0]:.0f} px, but the camera's fx is {camera.fx:.6g} px"
    )
    for factor, word in ((2.0, "double"), (0.5, "half")):
        if 1.0 / _SIZE_TOLERANCE < ratio / factor < _SIZE_TOLERANCE:
            yield grave(
                Cause.CALIBRATION_SIZE,
                f"{sentence}, {factor:g} times as much",
                f"give the calibration of frames of {camera.width} x {camera.height} px: that in"
                f" flight.toml seems to be of frames of {word} size",
                figures,
            )
            return
    yield mild(Cause.FOCAL_LENGTH, sentence, "give fx and fy of this camera and zoom", figures)


def _check_calibrated(headers: Sequence[FrameHeader], calibrated: ExifCamera) -> Iterator[Doubt]:
    differences = [(header.frame, *calibrated.difference(header.exif_camera)) for header in headers]
    others = [difference for difference in differences if any(difference[1:])]
    if not others:
        return
    frame, own, other = others[0]
    doubt = grave if 10 * len(others) > len(headers) else mild
    yield doubt(
        Cause.OTHER_CAMERA,
        f"by EXIF, the photographs of the calibration are by {own}, but {len(others)} of"
        f" {len(headers)} frames are not: {frame} is by {other}",
        "calibrate the camera of the frames with the zoom and crop of the flight; if it is the"
        " same, delete the keys exif_… in camera.toml",
        {"frames": float(len(others))},
    )
