"""From the white share of a disc's pixels to their grey values, with derivatives.

The light falls off over the scene, on ink and ground alike. The camera's tone curve and its
sharpening follow. sRGB's curve is a lookup table, and waves are power series: the functions of the
standard library would take most of the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.sharpening import Mask
from kgcp.measurement.image_model.srgb import srgb_encoded, srgb_slope


class Row(IntEnum):
    """Rows of the Jacobian, and of a disc's vector. Rows 0…4 are its centre and stretch [px]."""

    BLUR_MEAN = 5  # (xx + yy)/2 [px²]
    BLUR_DIFFERENCE = 6  # (xx − yy)/2 [px²]
    BLUR_XY = 7  # [px²]
    BLACK = 8  # light of the darker level, 1 at full scale
    WHITE = 9  # light of the brighter level
    SLOPE_X = 10  # relative change of the light per radius
    SLOPE_Y = 11
    WAVE_1 = 12  # of the tone curve
    WAVE_2 = 13
    WAVE_3 = 14
    SHARPENING = 15  # strength of the unsharp mask
    INK_SLOPE_X = 16  # change of the darker level alone, in contrasts per radius
    INK_SLOPE_Y = 17
    CURVE_XX = 18  # second order of the light, per square of the radius
    CURVE_XY = 19
    CURVE_YY = 20


COUNT = 21
GEOMETRY_COUNT = 5
_OF_SHARE = np.array([0, 1, 2, 3, 4, 6, 7, 8])  # rows of a white share's Jacobian
_FILTERED = np.array([Row.BLACK, Row.WHITE, *range(Row.BLACK), Row.SLOPE_X, Row.SLOPE_Y])
_LEVEL_ROWS_PER_PIXEL = 10  # of ink and plate, their derivatives by light, and by the waves
_MOST_LIGHT, _STEPS = 4.0, 1 << 16  # of the table of sRGB's curve
_WAVES = np.array([Row.WAVE_1, Row.WAVE_2, Row.WAVE_3])
# Taylor's coefficients of cos πx in x², and of −sin πx over x
_EVEN_TERMS = tuple((-1) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(11))
_ODD_TERMS = tuple(
    -((-1) ** k) * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(11)
)
CURVES = np.array([Row.CURVE_XX, Row.CURVE_XY, Row.CURVE_YY])
"""Rows of the light's second order."""


@dataclass(frozen=True, slots=True, eq=False)
class LevelModel:
    """Relation of white share to grey value, for the n pixels of one sample."""

    offsets: FloatArray  # (2, n): from the disc's middle, in radii
    tone: Tone
    mask: Mask | None  # unsharp mask of the camera; None: it does not sharpen

    def linearised(self, share: WhiteShare, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) before clipping and their Jacobian (21, n).

        Parameters
        ----------
        vector : (21,) array
            In the order of `Row`.
        """
        count = len(share.value)
        value, jacobian = np.empty(count), np.zeros((COUNT, count))
        beside = np.zeros((_LEVEL_ROWS_PER_PIXEL, count if self.mask is not None else 0))
        of_tone = (self.tone.is_srgb, self.tone.is_shaped)
        _expose(
            share.value,
            share.jacobian[_OF_SHARE],
            self.offsets,
            vector,
            of_tone,
            _srgb_table(),
            value,
            jacobian,
            beside,
        )
        if self.mask is None:
            return value, jacobian
        return self._sharpened(self.mask, value, jacobian, beside, vector)

    def _sharpened(
        self,
        mask: Mask,
        value: FloatArray,
        jacobian: FloatArray,
        beside: FloatArray,
        vector: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return grey values and Jacobian after the mask; the Jacobian is changed in place.

        Pixels within the mask that are not adjusted are taken for ink or plate. They change with
        all that these levels depend on.
        """
        strength, (ink, plate, by_ink, by_plate) = vector[Row.SHARPENING], beside[:4]
        x, y = self.offsets
        curves = np.stack((x * x, x * y, y * y))
        lit = 1.0 + vector[Row.SLOPE_X : Row.WAVE_1] @ self.offsets + vector[CURVES] @ curves
        rows = np.concatenate((_FILTERED, _WAVES)) if self.tone.is_shaped else _FILTERED
        mask.sharpen(jacobian, rows, (by_ink * lit, by_plate * lit), strength)
        others_ink, others_plate = strength * mask.ink, strength * mask.plate
        black, white = vector[Row.BLACK], vector[Row.WHITE]
        falling = others_ink * by_ink * black + others_plate * by_plate * white
        jacobian[Row.SLOPE_X : Row.WAVE_1] -= falling * self.offsets
        # if the second order is 0, its rows only serve the test whether it is needed: errors of a
        # few per cent do no harm
        if vector[CURVES].any():
            for row, curve in zip(CURVES, curves, strict=True):
                jacobian[row] += strength * mask.detail(jacobian[row], 0.0, 0.0) - falling * curve
        if self.tone.is_shaped:
            jacobian[_WAVES] -= others_ink * beside[4:7] + others_plate * beside[7:10]
        detail = mask.detail(value, ink, plate)
        jacobian[Row.SHARPENING] = detail
        return value + strength * detail, jacobian


@cache
def _srgb_table() -> FloatArray:
    """Return sRGB's curve and its slope (2, 65537) at even steps of light from 0 to 4."""
    light = np.linspace(0.0, _MOST_LIGHT, _STEPS + 1)
    return np.stack((srgb_encoded(light), srgb_slope(light)))


@inlined
def _looked_up(light: float, table: FloatArray) -> tuple[float, float]:
    """Return sRGB's grey value and its slope."""
    last = table.shape[1] - 1
    place = light * (last / _MOST_LIGHT)
    if place <= 0.0:
        return 12.92 * light, 12.92
    if place >= last:
        return table[0, last] + table[1, last] * (light - _MOST_LIGHT), table[1, last]
    low = int(place)
    share = place - low
    return (
        table[0, low] + share * (table[0, low + 1] - table[0, low]),
        table[1, low] + share * (table[1, low + 1] - table[1, low]),
    )


@inlined
def _sine_and_cosine(turn: float) -> tuple[float, float]:
    """Return sin πt and cos πt for t from 0 to 1, exact to rounding.

    The series are those about 1/2, where sin πt is even and cos πt is odd. They take a tenth of the
    time that the functions of the standard library take.
    """
    off = turn - 0.5
    square = off * off
    sine, cosine = _EVEN_TERMS[10], _ODD_TERMS[10]
    for k in range(9, -1, -1):
        sine, cosine = sine * square + _EVEN_TERMS[k], cosine * square + _ODD_TERMS[k]
    return sine, cosine * off


@inlined
def _waves(known: float) -> tuple[float, float, float, float, float, float]:
    """Return three waves at a grey value, and their slopes; beyond 0…1 waves are straight lines."""
    within = min(max(known, 0.0), 1.0)
    sine, cosine = _sine_and_cosine(within)
    slope_2, slope_3 = 2.0 * cosine * cosine - 1.0, cosine * (4.0 * cosine * cosine - 3.0)
    beyond = known - within
    return (
        sine / np.pi + beyond * cosine,
        sine * cosine / np.pi + beyond * slope_2,
        sine * (3.0 - 4.0 * sine * sine) / (3.0 * np.pi) + beyond * slope_3,
        cosine,
        slope_2,
        slope_3,
    )


@inlined
def _light_at(x: float, y: float, vector: FloatArray) -> tuple[float, float]:
    """Return the light relative to that in the middle, and what the ink alone gains in contrasts.

    x and y are in radii, from the middle.
    """
    lit = 1.0 + vector[10] * x + vector[11] * y
    lit += vector[18] * x * x + vector[19] * x * y + vector[20] * y * y
    return lit, vector[16] * x + vector[17] * y


@compiled
def _expose(
    share: FloatArray,
    by_shape: FloatArray,
    offsets: FloatArray,
    vector: FloatArray,
    of_tone: tuple[bool, bool],
    table: FloatArray,
    value: FloatArray,
    jacobian: FloatArray,
    beside: FloatArray,
) -> None:
    """Fill in grey values (n,), Jacobian (21, n), and the levels around every pixel.

    The latter, `beside`, has 10 rows, or no columns if they are not needed: grey values of ink and
    of plate, the derivatives of each by its light, and those of each by the three waves.
    """
    black, white = vector[8], vector[9]
    contrast, count = white - black, len(share)
    ink, plate, light = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        x, y = offsets[0, i], offsets[1, i]
        lit, more = _light_at(x, y, vector)
        ink[i], plate[i] = black * lit + contrast * more, white * lit
        light[i] = ink[i] + (plate[i] - ink[i]) * share[i]
    slopes = np.empty(count)
    _apply_curve(light, vector[12:15], of_tone, table, value, slopes, jacobian[12:15])
    if beside.shape[1] > 0:
        _apply_curve(ink, vector[12:15], of_tone, table, beside[0], beside[2], beside[4:7])
        _apply_curve(plate, vector[12:15], of_tone, table, beside[1], beside[3], beside[7:10])
    for i in range(count):
        x, y, s, slope = offsets[0, i], offsets[1, i], share[i], slopes[i]
        lit, more = _light_at(x, y, vector)
        jacobian[8, i] = slope * (1.0 - s) * (lit - more)
        jacobian[9, i] = slope * (s * lit + (1.0 - s) * more)
        falling = slope * (black * (1.0 - s) + white * s)
        jacobian[10, i], jacobian[11, i] = falling * x, falling * y
        jacobian[18, i], jacobian[19, i] = falling * x * x, falling * x * y
        jacobian[20, i] = falling * y * y
        of_ink = slope * (1.0 - s) * contrast
        jacobian[16, i], jacobian[17, i] = of_ink * x, of_ink * y
        slopes[i] = slope * (plate[i] - ink[i])
    for k in range(8):
        for i in range(count):
            jacobian[k, i] = slopes[i] * by_shape[k, i]


@compiled
def _apply_curve(
    light: FloatArray,
    amplitudes: FloatArray,
    of_tone: tuple[bool, bool],
    table: FloatArray,
    value: FloatArray,
    slope: FloatArray,
    waves: FloatArray,
) -> None:
    """Fill in grey values (n,) of light (n,), their slopes (n,), and waves (3, n) if there are any.

    The loop of the waves has no branch, so that it goes over vectors of pixels.
    """
    is_srgb, is_shaped = of_tone
    for i in range(len(light)):
        value[i], slope[i] = _looked_up(light[i], table) if is_srgb else (light[i], 1.0)
    if is_shaped:
        first, second, third = amplitudes
        for i in range(len(light)):
            wave_1, wave_2, wave_3, slope_1, slope_2, slope_3 = _waves(value[i])
            waves[0, i], waves[1, i], waves[2, i] = wave_1, wave_2, wave_3
            value[i] += first * wave_1 + second * wave_2 + third * wave_3
            slope[i] *= 1.0 + first * slope_1 + second * slope_2 + third * slope_3
