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

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.sharpening import Mask


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


# The gradient of the light is left out: over a whole ring, it is flat over the mask.
_FILTERED = [Param.BLACK, Param.WHITE, *range(9)]
_STREAK_ROWS = [Param.STREAK_X, Param.STREAK_Y]
_TONE_ROWS = [Param.TONE_1, Param.TONE_2, Param.TONE_3]
_SHARE_STEPS = 400


@dataclass(frozen=True, slots=True, eq=False)
class Imager:
    """From white share to grey value, for the n pixels of one sample.

    Attributes
    ----------
    offsets : (2, n) array
        From the target's centre, in ring radii.
    response : Response
        `linear` and `srgb` are applied as known; `unknown` uses the tone parameters.
    mask : Mask or None
        Of the camera's sharpening; None: it does not sharpen.
    """

    offsets: FloatArray
    response: Response
    mask: Mask | None

    def levels(self, share: FloatArray, light: Light) -> FloatArray:
        """Return the modelled grey values (n,) before clipping."""
        value = np.empty(len(share))
        _expose(share, self.offsets, light.values, value)
        value = encoded(value, self.response)
        if self.mask is None:
            return value
        return value + light.sharpening * self._detail(self.mask, value, light)

    def linearised(self, share: WhiteShare, light: Light) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) and their Jacobian (19, n)."""
        value = np.empty(len(share.value))
        jacobian = np.empty((PARAM_COUNT, len(value)))
        has_tone = self.response is Response.UNKNOWN
        _expose_with_slopes(
            share.value, share.jacobian, self.offsets, light.values, has_tone, value, jacobian
        )
        if self.response is Response.SRGB:
            jacobian *= srgb_slope(value)
            value = encoded(value, self.response)
        if self.mask is None:
            return value, jacobian
        self._sharpen(self.mask, jacobian, light)
        detail = self._detail(self.mask, value, light)
        jacobian[Param.SHARPENING] = detail
        return value + light.sharpening * detail, jacobian

    def _detail(self, mask: Mask, value: FloatArray, light: Light) -> FloatArray:
        """Return what the mask adds to the grey values at full strength.

        Where no edge is near there is no blur, and over the mask the light's gradient is flat.
        """
        return mask.detail(value, *plateau_levels(light, self.response))

    def _sharpen(self, mask: Mask, jacobian: FloatArray, light: Light) -> None:
        """Sharpen the rows of a Jacobian."""
        rows = [*_FILTERED, *(_TONE_ROWS if self.response is Response.UNKNOWN else [])]
        if jacobian[Param.STREAK_X].any() or jacobian[Param.STREAK_Y].any():
            rows += _STREAK_ROWS
        others = (1.0, 1.0)
        if self.response is Response.SRGB:
            ink, plate = srgb_slope(np.array([light.black, light.white])).tolist()
            others = (ink, plate)
        mask.sharpen(jacobian, np.array(rows), others, light.sharpening)


def share_at(level: float, light: Light, response: Response) -> float:
    """Return the white share at which a grey value is reached, 0…1; without a gradient of light."""
    return _share_at(float(decoded(np.array(level), response)), light.values)


@compiled
def _share_at(level: float, light: tuple[float, ...]) -> float:
    """Return where between ink and plate a level is first passed for good, by steps of 1/400."""
    black, white, _, _, tone_1, tone_2, tone_3, _ = light
    highest = black
    if level < highest:
        return 0.0
    for k in range(1, _SHARE_STEPS + 1):
        t = k / _SHARE_STEPS
        lean = 2.0 * t - 1.0
        tone = t + t * (1.0 - t) * (tone_1 + lean * (tone_2 + lean * tone_3))
        there = black + (white - black) * tone
        if there > level:
            return (k - 1 + (level - highest) / (there - highest)) / _SHARE_STEPS
        highest = max(highest, there)
    return 1.0


@compiled
def _expose(
    share: FloatArray, offsets: FloatArray, light: tuple[float, ...], value: FloatArray
) -> None:
    """Fill in black + (white − black) · tone(share), times the gradient of the light."""
    black, white, slope_x, slope_y, tone_1, tone_2, tone_3, _ = light
    for i in range(len(share)):
        t = share[i]
        lean = 2.0 * t - 1.0
        tone = t + t * (1.0 - t) * (tone_1 + lean * (tone_2 + lean * tone_3))
        lit = 1.0 + slope_x * offsets[0, i] + slope_y * offsets[1, i]
        value[i] = (black + (white - black) * tone) * lit


@compiled
def _expose_with_slopes(
    share: FloatArray,
    by_geometry: FloatArray,
    offsets: FloatArray,
    light: tuple[float, ...],
    has_tone: bool,  # noqa: FBT001 - compiled functions have no keywords
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Do as `_expose`, with derivatives by geometry (11, n), then in the order of `Param`."""
    black, white, slope_x, slope_y, tone_1, tone_2, tone_3, _ = light
    contrast, gains = white - black, np.empty(len(share))
    for i in range(len(share)):
        t = share[i]
        arch, lean = t * (1.0 - t), 2.0 * t - 1.0
        tone = t + arch * (tone_1 + lean * (tone_2 + lean * tone_3))
        slope = 1.0 - tone_1 * lean
        slope += tone_2 * (6.0 * arch - 1.0) + tone_3 * lean * (8.0 * arch - 1.0)
        lit = 1.0 + slope_x * offsets[0, i] + slope_y * offsets[1, i]
        core = black + contrast * tone
        value[i] = core * lit
        gain = contrast * lit
        gains[i] = gain * slope
        jacobian[11, i] = lit * (1.0 - tone)
        jacobian[12, i] = lit * tone
        jacobian[13, i], jacobian[14, i] = core * offsets[0, i], core * offsets[1, i]
        bend = gain * arch if has_tone else 0.0
        jacobian[15, i], jacobian[16, i], jacobian[17, i] = bend, bend * lean, bend * lean * lean
        jacobian[18, i] = 0.0
    for k in range(11):
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_geometry[k, i]
