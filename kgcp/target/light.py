"""From white share to grey value: levels, tone, a lit gradient, in-camera sharpening.

grey = sharpen(tone(black + (white − black) · share) · (1 + slope · offset)): the tone curve of an
unknown response is a monotone function of the share between ink and plate, here with three shape
parameters; sharpening is an unsharp mask on the pixel grid, after the tone curve as in cameras.
Together they are what displaces apparent edges: δ is a consequence here, not a parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response


class Param(IntEnum):
    """Rows of the Jacobian; the pose takes 0…5."""

    BLUR_MEAN = 6
    BLUR_DIFFERENCE = 7
    BLUR_XY = 8
    STREAK_X = 9
    STREAK_Y = 10
    BLACK = 11
    WHITE = 12
    SLOPE_X = 13
    SLOPE_Y = 14
    TONE_1 = 15
    TONE_2 = 16
    TONE_3 = 17
    SHARPENING = 18


PARAM_COUNT = 19


@dataclass(frozen=True, slots=True)
class Light:
    """Photometric parameters.

    Attributes
    ----------
    black, white : float
        Levels of ink and plate before clipping, 1 = full scale.
    slope_x, slope_y : float
        Relative gradient of the light over one ring radius.
    tone_1, tone_2, tone_3 : float
        Shape of an unknown tone curve between black and white; 0, 0, 0 is linear.
    sharpening : float
        Strength of the unsharp mask.
    """

    black: float
    white: float
    slope_x: float = 0.0
    slope_y: float = 0.0
    tone_1: float = 0.0
    tone_2: float = 0.0
    tone_3: float = 0.0
    sharpening: float = 0.0

    @property
    def values(self) -> tuple[float, ...]:
        """All eight, in the order of `Param`."""
        levels = (self.black, self.white, self.slope_x, self.slope_y)
        return (*levels, self.tone_1, self.tone_2, self.tone_3, self.sharpening)


def plateau_levels(light: Light, response: Response) -> tuple[float, float]:
    """Return the grey values of ink and plate before clipping.

    They are the light's own levels, but for a camera with a known encoding.
    """
    if response is not Response.SRGB:
        return light.black, light.white
    black, white = srgb_encoded(np.array([light.black, light.white])).tolist()
    return black, white


def encoded(level: FloatArray, response: Response) -> FloatArray:
    """Return grey values from the light of a camera with a known response."""
    return srgb_encoded(level) if response is Response.SRGB else level


def decoded(level: FloatArray, response: Response) -> FloatArray:
    """Return the light that gives grey values, of a camera with a known response."""
    return srgb_decoded(level) if response is Response.SRGB else level


def light_of_levels(black: float, white: float, response: Response) -> Light:
    """Return the light that gives these grey values of ink and plate."""
    if response is Response.SRGB:
        black, white = (float(level) for level in srgb_decoded(np.array([black, white])))
    return Light(black, white)


def srgb_decoded(level: FloatArray) -> FloatArray:
    """Return linear light from sRGB grey values, both 0…1 (IEC 61966-2-1)."""
    bright = ((np.maximum(level, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(level <= 0.04045, level / 12.92, bright)


def srgb_encoded(light: FloatArray) -> FloatArray:
    """Return sRGB grey values of linear light, both 0…1 (IEC 61966-2-1)."""
    safe = np.maximum(light, 0.0031308)
    return np.where(light > 0.0031308, 1.055 * safe ** (1.0 / 2.4) - 0.055, 12.92 * light)


def srgb_slope(light: FloatArray) -> FloatArray:
    """Return the derivative of `srgb_encoded`."""
    safe = np.maximum(light, 0.0031308)
    return np.where(light > 0.0031308, 1.055 / 2.4 * safe ** (1.0 / 2.4 - 1.0), 12.92)
