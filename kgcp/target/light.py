"""From white share to grey value: levels, tone, a lit gradient, in-camera sharpening.

grey = sharpen(tone(black + (white − black) · share) · (1 + slope · offset)): the tone curve of an
unknown response is a monotone function of the share between ink and plate, here with three shape
parameters; sharpening is an unsharp mask on the pixel grid, after the tone curve as in cameras.
Together they are what displaces apparent edges: δ is a consequence here, not a parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import WhiteShare
from kgcp.target.pairs import Blur
from kgcp.target.sharpening import Mask


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
_NO_POSE = (0.0,) * 6
_MIN_VARIANCE_PX2 = 0.075  # a pixel alone spreads by 1/12 px²
_MAX_ANISOTROPY = 0.95
# The gradient of the light is left out: over a whole ring, it is flat over the mask.
_FILTERED = [*range(9), Param.BLACK, Param.WHITE]
_STREAK_ROWS = [Param.STREAK_X, Param.STREAK_Y]
_TONE_ROWS = [Param.TONE_1, Param.TONE_2, Param.TONE_3]


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


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Everything that the adjustment estimates."""

    pose: Pose
    blur: Blur
    light: Light

    def moved(self, step: FloatArray) -> Parameters:
        """Return the parameters after a step (19,) in the order of `Param`."""
        values = (self.nuisance_vector + step).tolist()
        mean = max(values[Param.BLUR_MEAN], _MIN_VARIANCE_PX2)
        difference, xy = values[Param.BLUR_DIFFERENCE], values[Param.BLUR_XY]
        excess = math.hypot(difference, xy) / (_MAX_ANISOTROPY * mean)
        if excess > 1.0:  # the covariance must stay positive definite
            difference, xy = difference / excess, xy / excess
        streak = values[Param.STREAK_X : Param.STREAK_Y + 1]
        blur = Blur(mean + difference, mean - difference, xy, *streak)
        return Parameters(self.pose.moved(step[:6]), blur, Light(*values[Param.BLACK :]))

    @property
    def nuisance_vector(self) -> FloatArray:
        """All parameters (19,) in the order of `Param`, with zeros for the pose."""
        blur, light = self.blur, self.light
        mean, difference = 0.5 * (blur.xx + blur.yy), 0.5 * (blur.xx - blur.yy)
        values = (mean, difference, blur.xy, blur.streak_x, blur.streak_y, *light.values)
        return np.array((*_NO_POSE, *values))


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
    plateau : (q,) array
        White share of the mask's other pixels as if there were no blur; empty without a mask.
    """

    offsets: FloatArray
    response: Response
    mask: Mask | None
    plateau: FloatArray

    def levels(self, share: FloatArray, light: Light) -> FloatArray:
        """Return the modelled grey values (n,) before clipping."""
        core = light.black + (light.white - light.black) * tone_curve(share, light)
        value = encoded(core * self._lit(light), self.response)
        if self.mask is None:
            return value
        core = self._plateau_core(light)
        layers = np.concatenate((value, encoded(core, self.response)))[:, None]
        return value + light.sharpening * self.mask.detail(layers)[:, 0]

    def linearised(self, share: WhiteShare, light: Light) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) and their Jacobian (19, n)."""
        t = share.value
        arch = t * (1.0 - t)
        tone = tone_curve(t, light)
        slope = _tone_slope(t, light)
        contrast = light.white - light.black
        gain = self._lit(light)
        core = light.black + contrast * tone
        value = core * gain
        if self.response is Response.SRGB:
            encoding = _srgb_slope(value)
            value, gain, core = srgb_encoded(value), gain * encoding, core * encoding
        jacobian = np.empty((PARAM_COUNT, len(t)))
        np.multiply(share.jacobian, gain * contrast * slope, out=jacobian[:11])
        jacobian[Param.BLACK] = gain * (1.0 - tone)
        jacobian[Param.WHITE] = gain * tone
        np.multiply(self.offsets, core, out=jacobian[Param.SLOPE_X : Param.SLOPE_Y + 1])
        jacobian[Param.TONE_1 :] = 0.0
        if self.response is Response.UNKNOWN:
            jacobian[Param.TONE_1] = gain * contrast * arch
            jacobian[Param.TONE_2] = jacobian[Param.TONE_1] * (2.0 * t - 1.0)
            jacobian[Param.TONE_3] = jacobian[Param.TONE_2] * (2.0 * t - 1.0)
        if self.mask is None:
            return value, jacobian
        detail = self._detail(self.mask, value, jacobian, light)
        jacobian[Param.SHARPENING] = detail
        return value + light.sharpening * detail, jacobian

    def _lit(self, light: Light) -> FloatArray:
        lit: FloatArray = 1.0 + light.slope_x * self.offsets[0]
        lit += light.slope_y * self.offsets[1]
        return lit

    def _plateau_core(self, light: Light) -> FloatArray:
        """Return the light without blur; its gradient hardly changes over the mask."""
        return light.black + (light.white - light.black) * self.plateau

    def _detail(
        self, mask: Mask, value: FloatArray, jacobian: FloatArray, light: Light
    ) -> FloatArray:
        """Sharpen the rows of a Jacobian, and return what the mask adds to the grey values."""
        rows = [*_FILTERED, *(_TONE_ROWS if self.response is Response.UNKNOWN else [])]
        if jacobian[_STREAK_ROWS].any():
            rows += _STREAK_ROWS
        core = self._plateau_core(light)
        gain = _srgb_slope(core) if self.response is Response.SRGB else 1.0
        bright = gain * self.plateau
        count = len(value)
        layers = np.zeros((count + len(core), 1 + len(rows)))
        layers[:count, 0], layers[count:, 0] = value, encoded(core, self.response)
        layers[:count, 1:] = jacobian[rows].T
        layers[count:, 1 + rows.index(Param.BLACK)] = gain - bright
        layers[count:, 1 + rows.index(Param.WHITE)] = bright
        detail = mask.detail(layers)
        jacobian[rows] += light.sharpening * detail[:, 1:].T
        return detail[:, 0]


def tone_curve(share: FloatArray, light: Light) -> FloatArray:
    """Return the tone curve (n,) between ink (0) and plate (1), at white shares (n,)."""
    arch, lean = share * (1.0 - share), 2.0 * share - 1.0
    tone: FloatArray = share + arch * (light.tone_1 + lean * (light.tone_2 + lean * light.tone_3))
    return tone


def share_at(level: float, light: Light, response: Response) -> float:
    """Return the white share at which a grey value is reached, 0…1; without a gradient of light."""
    share = np.linspace(0.0, 1.0, 401)
    core = light.black + (light.white - light.black) * tone_curve(share, light)
    grey = np.maximum.accumulate(encoded(core, response))
    return float(np.interp(level, grey, share))


def _tone_slope(share: FloatArray, light: Light) -> FloatArray:
    arch, lean = share * (1.0 - share), 2.0 * share - 1.0
    slope: FloatArray = (
        1.0
        - light.tone_1 * lean
        + light.tone_2 * (6.0 * arch - 1.0)
        + light.tone_3 * lean * (8.0 * arch - 1.0)
    )
    return slope


def plateau_levels(light: Light, response: Response) -> tuple[float, float]:
    """Return the grey values of ink and plate before clipping.

    They are the light's own levels, but for a camera with a known encoding.
    """
    black, white = encoded(np.array([light.black, light.white]), response)
    return float(black), float(white)


def encoded(level: FloatArray, response: Response) -> FloatArray:
    """Return grey values from the light of a camera with a known response."""
    return srgb_encoded(level) if response is Response.SRGB else level


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


def _srgb_slope(light: FloatArray) -> FloatArray:
    safe = np.maximum(light, 0.0031308)
    return np.where(light > 0.0031308, 1.055 / 2.4 * safe ** (1.0 / 2.4 - 1.0), 12.92)
