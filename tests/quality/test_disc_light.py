"""Negatives and burnt photographs are recognised by how their levels change with the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.measurement.discs.records import Operator
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.measurement.field_photograph import PhotoDiscs, PhotoTask, measure_field
from kgcp.quality.disc_light import DiscLight, light_on_discs
from kgcp.simulation.field_session import FieldSession, field_photograph, printed_points
from kgcp.targets.fields.layout import Field, FieldPolarity, GridKind, Mark

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

PLACES_PX = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * 80.0


def light(fall: float) -> FloatArray:
    """Light (k,) that falls off from the first corner, by so much over the frame."""
    off = PLACES_PX / PLACES_PX.max(axis=0)
    return np.asarray(1.0 - 0.5 * fall * (off**2).sum(axis=1))


def of_levels(inside: FloatArray, outside: FloatArray, clipped: float = 0.0) -> DiscLight:
    levels = np.column_stack((inside, outside))
    return light_on_discs([(PLACES_PX, levels, np.full(len(levels), clipped))] * 2)


def test_light_changes_bright_levels_most() -> None:
    found = of_levels(0.2 * light(0.5), 0.8 * light(0.5))
    assert found.bright == pytest.approx(4.0 * found.dark)
    assert found.bright == pytest.approx(0.8 * float(np.std(light(0.5))))
    assert found.doubt == ""


def test_uniform_reflections_raise_no_doubt() -> None:
    glare = 0.2 * light(0.9)
    assert of_levels(0.05 + glare, 0.6 + glare).doubt == ""


def test_reflections_that_a_tone_curve_shows_in_the_dark_are_named() -> None:
    """They pass for negatives: the slope of sRGB's curve is larger there."""
    glare = 0.1 * light(1.0)
    found = of_levels((0.04 + glare) ** (1.0 / 2.4), (0.6 + glare) ** (1.0 / 2.4))
    assert found.doubt.endswith("or the field reflects light")


@pytest.mark.parametrize("is_bright", [False, True])
def test_negatives_are_recognised_with_any_discs(*, is_bright: bool) -> None:
    levels = (1.0 - 0.1 * light(0.6), 1.0 - 0.8 * light(0.6))
    found = of_levels(*(levels if is_bright else levels[::-1]))
    assert "only: they are negatives" in found.doubt
    assert 0.1 < found.bright / found.dark < 0.15


@pytest.mark.parametrize("clipped", [0.3, np.nan])
def test_burnt_white_may_be_the_cause(clipped: float) -> None:
    found = of_levels(0.4 * light(0.6), np.ones(len(PLACES_PX)), clipped)
    assert "only: white is burnt, or they are negatives" in found.doubt


def test_single_burnt_photographs_raise_no_doubt() -> None:
    """Where white is burnt, discs may be fitted without their ink: its level is anything."""
    levels = np.column_stack((0.2 * light(0.3), 0.8 * light(0.3)))
    burnt = np.column_stack((0.2 + 0.5 * light(0.9), np.ones(len(PLACES_PX))))
    clipped = np.zeros(len(PLACES_PX))
    good = [(PLACES_PX, levels, clipped)] * 4
    assert light_on_discs([*good, (PLACES_PX, burnt, clipped + 0.5)] * 2).doubt == ""
    assert "burnt" in light_on_discs([(PLACES_PX, burnt, clipped + 0.5)] * 2).doubt


def test_negatives_are_recognised_if_light_falls_off_in_some_photographs() -> None:
    def negative(fall: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        levels = np.column_stack((1.0 - 0.8 * light(fall), 1.0 - 0.1 * light(fall)))
        return PLACES_PX, levels, np.zeros(len(PLACES_PX))

    assert (
        "negatives" in light_on_discs([negative(0.6), negative(0.6), *[negative(0.05)] * 6]).doubt
    )


def test_even_light_raises_no_doubt() -> None:
    assert of_levels(1.0 - 0.1 * light(0.05), 1.0 - 0.8 * light(0.05)).doubt == ""


def test_single_levels_that_are_off_do_not_count() -> None:
    """As of discs under dirt: noise of 0.3 on four of 35, that would count 0.1."""
    dark = 0.2 * light(0.2)
    dark[[3, 11, 20, 30]] += 0.3
    assert of_levels(dark, 0.8 * light(0.2)).dark < 0.015


def test_the_negative_of_a_photograph_is_recognised() -> None:
    marks = (Mark(1, 1, 0.013, 0.006),)
    field = Field("board", GridKind.SQUARE, 7, 5, 0.024, 0.013, marks=marks)
    camera = Camera(800, 600, 1000.0, 1000.0, 404.0, 297.0, -0.1)
    session = FieldSession(camera, field, photographs=4, fall=0.4)
    rng = np.random.default_rng(18)
    grey = field_photograph(session, printed_points(session, rng), 0, rng).grey
    inverted = replace(field, polarity=FieldPolarity.BRIGHT)
    doubts = []
    for photo, own in ((grey, field), (255 - grey, inverted)):
        task = PhotoTask(own, Response.LINEAR, Operator.MODEL)
        found = measure_field(photo, task, "p", ExifCamera())
        assert isinstance(found, PhotoDiscs)
        levels, clipped = found.appearance[:, :2], found.appearance[:, 3]
        doubts.append(light_on_discs([(found.vectors[:, :2], levels, clipped)]).doubt)
    assert doubts[0] == ""
    assert "only: they are negatives" in doubts[1]
