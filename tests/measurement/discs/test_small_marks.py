"""Hollow marks whose holes are too small for an outline of their own."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoTask, measure_field
from kgcp.simulation.field_session import FieldPhotograph, FieldSession, field_photograph
from kgcp.targets.fields.layout import Field, FieldPolarity, GridKind, Mark

CAMERA = Camera(360, 270, 430.0, 430.0, 181.0, 133.0, -0.1)
BLURRED_PX = 0.5  # σ, besides that of the lens


def board(*, is_bright: bool = False) -> Field:
    polarity = FieldPolarity.BRIGHT if is_bright else FieldPolarity.DARK
    marks = (Mark(3, 2, 0.011, 0.0047),)
    return Field("board", GridKind.SQUARE, 11, 8, 0.024, 0.011, polarity=polarity, marks=marks)


@cache
def photographs(*, is_bright: bool) -> list[FieldPhotograph]:
    field, rng = board(is_bright=is_bright), np.random.default_rng(4)
    session = FieldSession(CAMERA, field)
    return [field_photograph(session, field.points_m(), number, rng) for number in range(4)]


def sharpened(grey: GreyArray) -> GreyArray:
    values = grey.astype(np.float64)
    masked = values + 1.5 * (values - cv2.GaussianBlur(values, (0, 0), 1.5))
    return np.clip(np.round(masked), 0.0, 255.0).astype(np.uint8)


@pytest.mark.parametrize("kind", ["dark", "bright", "blurred", "sharpened"])
def test_discs_are_named_by_a_mark_whose_hole_has_no_outline(kind: str) -> None:
    field = board(is_bright=kind == "bright")
    unseen = 0
    for taken in photographs(is_bright=kind == "bright"):
        grey = taken.grey
        if kind == "blurred":
            grey = cv2.GaussianBlur(grey, (0, 0), BLURRED_PX)
        elif kind == "sharpened":
            grey = sharpened(grey)
        discs = [
            each
            for each in find_outlines(grey)
            if each.polarity.value == field.polarity.value and not each.is_hole
        ]
        unseen += all(each.hole is None for each in discs)
        task = PhotoTask(field, Response.LINEAR, Operator.CENTROID)
        found = measure_field(grey, task, "p", ExifCamera())
        assert isinstance(found, PhotoDiscs), found
        named = found.point.astype(np.intp)
        camera_points = field.points_m()[named] @ taken.pose.rotation.T + taken.pose.translation_m
        off_px = found.vectors[:, :2] - CAMERA.project(camera_points)
        assert np.abs(off_px).max() < 2.0, "another disc's name is 9 px off or more"
    assert unseen >= 2, "holes have outlines: nothing is tested"
