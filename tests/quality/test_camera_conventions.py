"""Differences between two calibrations that are a matter of convention."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.quality.camera_conventions import convention_words

CAMERA = Camera(1600, 1200, 2306.0, 2302.0, 792.6, 603.9, -0.072, 0.055, 0.0004, -0.0003)
RAY_SD_PX = 0.01
SD = np.array([0.02, 0.02, 0.04, 0.04, 1e-4, 2e-3, 5e-6, 5e-6, 0.0, 0.0, 0.0, 0.0])


def words(other: Camera) -> str:
    """By another program, whose camera differs by a few standard deviations besides."""
    fx, fy, cx, cy = other.fx + 0.03, other.fy + 0.02, other.cx - 0.04, other.cy + 0.03
    almost = replace(other, fx=fx, fy=fy, cx=cx, cy=cy)
    return convention_words(CAMERA, almost, SD, RAY_SD_PX)


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (replace(CAMERA, cx=793.1, cy=604.4), "cx and cy are half a pixel larger"),
        (replace(CAMERA, cx=792.1, cy=603.4), "cx and cy are half a pixel smaller"),
        (
            replace(CAMERA, fx=1153.0, fy=1151.0, cx=396.05, cy=301.7),
            "frames of 0.5 times this size",
        ),
        (replace(CAMERA, fx=2310.6, fy=2306.6), "focal length is 0.2 % longer"),
        (replace(CAMERA, cx=892.6, cy=543.9), "off by +100 px in x and −60 px in y"),
        (replace(CAMERA, p1=-0.0003, p2=0.0004), "p1 and p2 seem to be exchanged."),
        (replace(CAMERA, p1=-0.0004, p2=0.0003), "p1 and p2 seem to have the opposite sign"),
        (replace(CAMERA, k1=0.072, k2=-0.055), "radial distortion seems to have the opposite sign"),
        (replace(CAMERA, cx=806.4, cy=595.1, p1=-0.0004, p2=0.0003), "turned by 180°"),
    ],
)
def test_a_convention_that_explains_the_difference_is_named(other: Camera, told: str) -> None:
    assert told in words(other)


def test_other_differences_are_no_convention() -> None:
    assert not words(CAMERA)
    assert not words(replace(CAMERA, cx=793.1))  # in x only
    assert not words(replace(CAMERA, k1=-0.08))
    assert not words(replace(CAMERA, fx=2306.0 * 1.002))
    assert not words(replace(CAMERA, cx=793.1, cy=604.4, k1=-0.08))  # not alone


def test_a_principal_point_that_is_hardly_known_may_be_half_a_pixel_off_by_chance() -> None:
    half = replace(CAMERA, cx=793.1, cy=604.4)
    assert not convention_words(CAMERA, half, 10.0 * SD, 10.0 * RAY_SD_PX)


def test_a_camera_of_another_kind_is_compared_without_an_error() -> None:
    """Undone, some conventions would put the principal point far outside the frame."""
    far = Camera(1600, 1200, 20.0, 20.0, 2300.0, -500.0, 3.0, k4=-0.5)
    assert not convention_words(CAMERA, far, SD, RAY_SD_PX)
