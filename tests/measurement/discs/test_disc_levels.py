"""Grey values of discs: the tone curve, and derivatives compared with differences."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.discs.disc_levels import COUNT, LevelModel, Row
from kgcp.measurement.discs.tone_curve import DiscTone, plausible, steep_enough
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.sharpening import unsharp_mask
from kgcp.measurement.image_model.srgb import srgb_encoded

SIDE = 24
ROWS, COLUMNS = (each.ravel().astype(np.float64) for each in np.mgrid[0:SIDE, 0:SIDE])
FAR_PX = np.hypot(COLUMNS - 11.3, ROWS - 12.1) - 6.0
SHARE = 0.5 + 0.5 * np.tanh(FAR_PX)
NEAR = np.flatnonzero((np.abs(FAR_PX) < 4.0) & ((ROWS + COLUMNS) % 2 == 0))  # as of large discs
LEVEL_ROWS = [
    *(Row.BLACK, Row.WHITE, Row.SLOPE_X, Row.SLOPE_Y),
    *(Row.WAVE_1, Row.WAVE_2, Row.WAVE_3, Row.SHARPENING),
    *(Row.CURVE_XX, Row.CURVE_XY, Row.CURVE_YY),
]


def vector() -> FloatArray:
    values = np.zeros(COUNT)
    values[LEVEL_ROWS] = 0.12, 0.66, 0.03, -0.05, 0.1, -0.5, 0.05, 0.4, 0.02, 0.01, -0.03
    return values


def levels(tone: Tone, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    offsets = np.stack((COLUMNS[NEAR] - 11.3, ROWS[NEAR] - 12.1)) / 6.0
    mask = unsharp_mask((SIDE, SIDE), NEAR, SHARE, 1.0)
    share = WhiteShare(offsets, SHARE[NEAR], np.zeros((11, len(NEAR))))
    return LevelModel(offsets, tone, mask).linearised(share, values)


@pytest.mark.parametrize("tone", [Tone.LINEAR, Tone.SRGB, Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE])
def test_derivatives_contain_changes_of_sharpened_neighbours(tone: Tone) -> None:
    """The mask also covers pixels that are not modelled but depend on light and tone."""
    _, jacobian = levels(tone, vector())
    for row in LEVEL_ROWS:
        step = np.zeros(COUNT)
        step[row] = 1e-5
        slopes = (levels(tone, vector() + step)[0] - levels(tone, vector() - step)[0]) / 2e-5
        assert np.abs(jacobian[row] - slopes).max() < 2e-3 * max(np.abs(slopes).max(), 0.1)


def test_the_tabulated_curve_equals_srgb() -> None:
    values = vector()
    values[Row.SLOPE_X :] = 0.0
    found, _ = levels(Tone.SRGB, values)
    light = 0.12 + 0.54 * SHARE[NEAR]
    assert np.abs(found - srgb_encoded(light)).max() < 1e-7


@pytest.mark.parametrize("tone", [Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE])
def test_grey_values_and_waves_are_those_of_the_curve(tone: Tone) -> None:
    """The compiled series agree with library functions, also beyond black and white."""
    light = np.linspace(-0.1, 1.4, 200)
    offsets, share = np.zeros((2, 200)), WhiteShare(np.zeros((15, 200)), light, np.zeros((11, 200)))
    values, waves = np.zeros(COUNT), np.array((0.1, -0.5, 0.05))
    values[Row.WHITE] = 1.0
    values[Row.WAVE_1 : Row.SHARPENING] = waves
    found, jacobian = LevelModel(offsets, tone, None).linearised(share, values)
    curve = DiscTone(tone)
    tolerance = 1e-6 if tone.is_srgb else 1e-14  # sRGB's curve is a table
    assert np.abs(found - curve.bent(waves).levels(light)).max() < tolerance
    for row, wave in zip(jacobian[Row.WAVE_1 : Row.SHARPENING], np.eye(3), strict=True):
        difference = curve.bent(wave).levels(light) - curve.levels(light)
        assert np.abs(row - difference).max() < tolerance


@pytest.mark.parametrize("tone", [Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE])
def test_every_level_can_be_converted_to_light(tone: Tone) -> None:
    curve = DiscTone(tone, (0.2, -0.6, 0.1))
    light = np.linspace(-0.1, 1.6, 50)
    assert curve.light(curve.levels(light)) == pytest.approx(light, abs=1e-9)


def test_curves_rise_everywhere() -> None:
    waves = steep_enough(np.array((1.5, -2.0, 0.3)))
    light = np.linspace(0.0, 1.0, 2000)
    curve = DiscTone(Tone.UNKNOWN_OVER_LINE).bent(waves)
    slopes = np.diff(curve.levels(light)) / np.diff(light)
    assert 0.3 < slopes.min() < 0.36
    few = np.array((0.1, -0.2, 0.0))
    assert np.all(steep_enough(few) == few)


@pytest.mark.parametrize("tone", [Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE])
def test_curves_do_not_darken_dark_light(tone: Tone) -> None:
    """No curve is below a straight line by more than an error of the black level."""
    waves = np.array((-1.04, 0.63, -0.25) if tone.is_srgb else (-0.6, 0.0, 0.0))
    light = np.linspace(0.02, 0.4, 39)
    darker, allowed = (
        float((light - DiscTone(tone).bent(each).levels(light)).max())
        for each in (steep_enough(waves), plausible(waves, tone))
    )
    assert darker > 0.1
    assert 0.0 < allowed < 0.05
