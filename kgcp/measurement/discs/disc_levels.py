"""From the white share of a disc's pixels to their grey values, with derivatives.

The light falls off over the scene, on ink and ground alike. The camera's tone curve and its
sharpening follow. sRGB's curve is a lookup table: powers would take most of the time.
"""

from __future__ import annotations

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
def _waves(known: float) -> tuple[float, float, float, float, float, float]:
    """Return three waves at a grey value, and their slopes; beyond 0…1 waves are straight lines."""
    within = min(max(known, 0.0), 1.0)
    sine, cosine = np.sin(np.pi * within), np.cos(np.pi * within)
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
    is_srgb, is_shaped = of_tone
    black, white, slope_x, slope_y = vector[8], vector[9], vector[10], vector[11]
    contrast, needs_levels = white - black, beside.shape[1] > 0
    gains = np.empty(len(share))
    for i in range(len(share)):
        x, y, s = offsets[0, i], offsets[1, i], share[i]
        lit = 1.0 + slope_x * x + slope_y * y
        lit += vector[18] * x * x + vector[19] * x * y + vector[20] * y * y
        more = vector[16] * x + vector[17] * y
        ink, plate = black * lit + contrast * more, white * lit
        light = ink + (plate - ink) * s
        level, slope = _looked_up(light, table) if is_srgb else (light, 1.0)
        if is_shaped:
            wave_1, wave_2, wave_3, slope_1, slope_2, slope_3 = _waves(level)
            jacobian[12, i], jacobian[13, i], jacobian[14, i] = wave_1, wave_2, wave_3
            level += vector[12] * wave_1 + vector[13] * wave_2 + vector[14] * wave_3
            slope *= 1.0 + vector[12] * slope_1 + vector[13] * slope_2 + vector[14] * slope_3
        value[i] = level
        gains[i] = slope * (plate - ink)
        jacobian[8, i] = slope * (1.0 - s) * (lit - more)
        jacobian[9, i] = slope * (s * lit + (1.0 - s) * more)
        falling = slope * (black * (1.0 - s) + white * s)
        jacobian[10, i], jacobian[11, i] = falling * x, falling * y
        jacobian[18, i], jacobian[19, i] = falling * x * x, falling * x * y
        jacobian[20, i] = falling * y * y
        of_ink = slope * (1.0 - s) * contrast
        jacobian[16, i], jacobian[17, i] = of_ink * x, of_ink * y
        if needs_levels:
            for k in range(2):
                light = ink if k == 0 else plate
                level, slope = _looked_up(light, table) if is_srgb else (light, 1.0)
                if is_shaped:
                    wave_1, wave_2, wave_3, slope_1, slope_2, slope_3 = _waves(level)
                    beside[4 + 3 * k, i], beside[5 + 3 * k, i] = wave_1, wave_2
                    beside[6 + 3 * k, i] = wave_3
                    level += vector[12] * wave_1 + vector[13] * wave_2 + vector[14] * wave_3
                    slope *= (
                        1.0 + vector[12] * slope_1 + vector[13] * slope_2 + vector[14] * slope_3
                    )
                beside[k, i], beside[2 + k, i] = level, slope
    for k in range(8):
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_shape[k, i]
