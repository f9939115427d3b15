"""The convention that may explain nearly all of the difference between two calibrations.

Half a pixel, another scale or crop of the frames, and exchanged or negated coefficients are slips
in reading or writing a calibration, which no better photographs would remove.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.quality.frame_rays import compare_cameras
from kgcp.quality.number_text import minus

_MAX_LEFT = 0.2  # share of the difference that may be left when the convention is undone
# From half a pixel. None of 1500 right cameras, 1 to 100 times less certain than a simulated
# calibration, was so near by chance; with twice the limit, 8 were.
_MAX_OFF_PX = 0.07
_MIN_SDS = 3.0  # of a difference that is not by chance
_MIN_SCALE = 0.02  # relative, of resized frames; below, only the focal length is another
_MIN_CROP = 0.01  # of the frame's width; principal points of one camera mostly differ by less
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")


def convention_words(camera: Camera, other: Camera, sd: FloatArray, ray_sd_px: float) -> str:
    """Return what explains how the calibration of a camera differs from another one, in words.

    Parameters
    ----------
    sd : (12,) array
        Standard deviations of `CALIBRATION_PARAMETERS` of `camera`.
    ray_sd_px : float
        Standard deviation of its rays, apart from a rotation of the camera [px].

    Returns
    -------
    str
        Empty if no convention explains nearly all of it, or if it may be by chance.
    """
    half = _half_a_pixel(camera, other, sd)
    if half:
        return half
    difference_px = _rms_px(camera, other)
    if not difference_px > _MIN_SDS * ray_sd_px:
        return ""
    left = ((_rms_px(camera, undone), words) for words, undone in _conventions(camera, other))
    likely = [(px, words) for px, words in left if px < _MAX_LEFT * difference_px]
    if not likely:
        return ""
    left_px, words = min(likely)
    return f"{words}. That explains the difference but for {left_px:.2g} px."


def _half_a_pixel(camera: Camera, other: Camera, sd: FloatArray) -> str:
    """Return the words for principal points that differ by half a pixel, which a rotation hides."""
    sd_px = float(np.hypot(*sd[[CALIBRATION_PARAMETERS.index(name) for name in ("cx", "cy")]]))
    for half_px in (0.5, -0.5):
        undone = replace(other, cx=other.cx - half_px, cy=other.cy - half_px)
        off_px = math.hypot(undone.cx - camera.cx, undone.cy - camera.cy)
        is_alone = max(off_px, _rms_px(camera, undone)) < _MAX_OFF_PX
        if is_alone and math.sqrt(0.5) > _MIN_SDS * sd_px:
            return (
                f"Its cx and cy are half a pixel {'larger' if half_px > 0.0 else 'smaller'}, as"
                " between programs that put (0, 0) at the corner of the top-left pixel and those"
                " that, like kgcp, put it at its centre."
            )
    return ""


def _rms_px(camera: Camera, other: Camera) -> float:
    return compare_cameras(camera, other).rms_px


def _conventions(camera: Camera, other: Camera) -> Iterator[tuple[str, Camera]]:
    """Yield conventions, in words, with the other camera as it would be without them."""
    scale = camera.mean_focal_px / other.mean_focal_px
    zoomed = replace(other, fx=scale * other.fx, fy=scale * other.fy)
    cx, cy = scale * (other.cx + 0.5) - 0.5, scale * (other.cy + 0.5) - 0.5
    if abs(scale - 1.0) > _MIN_SCALE and _is_in_frame(camera, cx, cy):
        resized = replace(zoomed, cx=cx, cy=cy)
        yield f"It seems to be for frames of {1.0 / scale:.4g} times this size", resized
    share = f"{100.0 * abs(1.0 / scale - 1.0):.2g} % {'longer' if scale < 1.0 else 'shorter'}"
    yield f"Its focal length is {share}, as with another focus or zoom", zoomed

    right_px, down_px = other.cx - camera.cx, other.cy - camera.cy
    if math.hypot(right_px, down_px) > _MIN_CROP * camera.width:
        right, down = minus(f"{right_px:+.0f}"), minus(f"{down_px:+.0f}")
        words = (
            f"Its principal point is off by {right} px in x and {down} px in y, as for frames that"
            " are cropped otherwise"
        )
        yield words, replace(other, cx=camera.cx, cy=camera.cy)

    p1, p2 = other.p1, other.p2
    exchanged = replace(other, p1=p2, p2=p1)
    yield "Its p1 and p2 seem to be exchanged", exchanged
    yield "Its p1 and p2 seem to have the opposite sign", replace(other, p1=-p1, p2=-p2)
    words = "Its p1 and p2 seem to be exchanged, with the opposite sign"
    yield words, replace(exchanged, p1=-p2, p2=-p1)
    words = "Its radial distortion seems to have the opposite sign: to correct pixels, not rays"
    yield words, replace(other, **{name: -getattr(other, name) for name in _RADIAL})

    cx, cy = other.width - 1.0 - other.cx, other.height - 1.0 - other.cy
    if _is_in_frame(other, cx, cy):
        turned = replace(other, cx=cx, cy=cy, p1=-p1, p2=-p2)
        yield "It seems to be for frames that are turned by 180°", turned


def _is_in_frame(camera: Camera, x: float, y: float) -> bool:
    return 0.0 < x < camera.width and 0.0 < y < camera.height
