"""From white share to grey value: levels, tone, a lit gradient, in-camera sharpening.

grey = sharpen(tone(black + (white − black) · share) · (1 + slope · offset)): the tone curve of an
unknown response is a monotone function of the share between ink and plate, here with three shape
parameters; sharpening is an unsharp mask on the pixel grid, after the tone curve as in cameras.
Together they are what displaces apparent edges: δ is a consequence here, not a parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Response
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import WhiteShare
from kgcp.target.pairs import Blur


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
_MIN_VARIANCE_PX2 = 0.075  # a pixel alone spreads by 1/12 px²
_MAX_ANISOTROPY = 0.95
# The gradient of the light is left out: over a whole ring, it is flat over the mask.
_FILTERED = [*range(11), Param.BLACK, Param.WHITE, *range(Param.TONE_1, Param.SHARPENING)]


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


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Everything that the adjustment estimates."""

    pose: Pose
    blur: Blur
    light: Light

    def moved(self, step: FloatArray) -> Parameters:
        """Return the parameters after a step (19,) in the order of `Param`."""
        old = self.blur
        mean = max(0.5 * (old.xx + old.yy) + float(step[Param.BLUR_MEAN]), _MIN_VARIANCE_PX2)
        difference = 0.5 * (old.xx - old.yy) + float(step[Param.BLUR_DIFFERENCE])
        xy = old.xy + float(step[Param.BLUR_XY])
        excess = float(np.hypot(difference, xy)) / (_MAX_ANISOTROPY * mean)
        if excess > 1.0:  # the covariance must stay positive definite
            difference, xy = difference / excess, xy / excess
        blur = Blur(
            mean + difference,
            mean - difference,
            xy,
            old.streak_x + float(step[Param.STREAK_X]),
            old.streak_y + float(step[Param.STREAK_Y]),
        )
        names = [field.name for field in fields(Light)]
        values = {
            name: getattr(self.light, name) + float(step[Param.BLACK + i])
            for i, name in enumerate(names)
        }
        return Parameters(self.pose.moved(step[:6]), blur, replace(self.light, **values))

    @property
    def nuisance_vector(self) -> FloatArray:
        """All parameters (19,) in the order of `Param`, with zeros for the pose."""
        blur, light = self.blur, self.light
        values = [getattr(light, field.name) for field in fields(Light)]
        return np.array(
            [
                *[0.0] * 6,
                *(0.5 * (blur.xx + blur.yy), 0.5 * (blur.xx - blur.yy), blur.xy),
                *(blur.streak_x, blur.streak_y),
                *values,
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Where the modelled pixels lie in their window.

    Attributes
    ----------
    width, height : int
        Of the window [px].
    index : (n,) array
        Of the modelled pixels in the flattened window.
    offsets : (2, n) array
        From the target's centre, in ring radii.
    plateau : (height × width,) array, or (0,)
        White share of all pixels as if there were no blur; the modelled ones' is replaced. Empty
        where the camera does not sharpen.
    """

    width: int
    height: int
    index: IndexArray
    offsets: FloatArray
    plateau: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Imager:
    """From white share to grey value, for the pixels of one sample.

    Attributes
    ----------
    grid : Grid
    response : Response
        `linear` and `srgb` are applied as known; `unknown` uses the tone parameters.
    sharpening_px : float
        σ of the unsharp mask [px]; 0: the camera does not sharpen.
    """

    grid: Grid
    response: Response
    sharpening_px: float

    def levels(self, share: FloatArray, light: Light) -> FloatArray:
        """Return the modelled grey values (n,) before clipping."""
        core = light.black + (light.white - light.black) * tone_curve(share, light)
        value = encoded(core * self._lit(light), self.response)
        if self.sharpening_px == 0.0:
            return value
        layers = self._plateaus(light)[:, None]
        layers[self.grid.index, 0] = value
        return value + light.sharpening * self._detail(layers)[:, 0]

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
        np.multiply(self.grid.offsets, core, out=jacobian[Param.SLOPE_X : Param.SLOPE_Y + 1])
        jacobian[Param.TONE_1] = gain * contrast * arch
        jacobian[Param.TONE_2] = jacobian[Param.TONE_1] * (2.0 * t - 1.0)
        jacobian[Param.TONE_3] = jacobian[Param.TONE_2] * (2.0 * t - 1.0)
        jacobian[Param.SHARPENING] = 0.0
        return (
            (value, jacobian)
            if self.sharpening_px == 0.0
            else self._sharpened(value, jacobian, light)
        )

    def _lit(self, light: Light) -> FloatArray:
        lit: FloatArray = 1.0 + light.slope_x * self.grid.offsets[0]
        lit += light.slope_y * self.grid.offsets[1]
        return lit

    def _plateaus(self, light: Light) -> FloatArray:
        """Return the window without blur; the light's gradient hardly changes over the mask."""
        plateau = self.grid.plateau
        return encoded(light.black + (light.white - light.black) * plateau, self.response)

    def _sharpened(
        self, value: FloatArray, jacobian: FloatArray, light: Light
    ) -> tuple[FloatArray, FloatArray]:
        grid = self.grid
        layers = np.zeros((len(grid.plateau), 1 + len(_FILTERED)))
        layers[:, 0] = self._plateaus(light)
        gain = np.ones_like(grid.plateau)
        if self.response is Response.SRGB:
            gain = _srgb_slope(light.black + (light.white - light.black) * grid.plateau)
        layers[:, 1 + _FILTERED.index(Param.BLACK)] = gain * (1.0 - grid.plateau)
        layers[:, 1 + _FILTERED.index(Param.WHITE)] = gain * grid.plateau
        layers[grid.index, 0] = value
        layers[grid.index, 1:] = jacobian[_FILTERED].T
        detail = self._detail(layers)
        jacobian[_FILTERED] += light.sharpening * detail[:, 1:].T
        jacobian[Param.SHARPENING] = detail[:, 0]
        return value + light.sharpening * detail[:, 0], jacobian

    def _detail(self, layers: FloatArray) -> FloatArray:
        """Return what an unsharp mask adds at the modelled pixels, for layers of the window."""
        grid, sigma = self.grid, self.sharpening_px
        kernel = cv2.getGaussianKernel(2 * int(np.ceil(3.0 * sigma)) + 1, sigma)
        stack = layers.reshape(grid.height, grid.width, -1)
        smooth = cv2.sepFilter2D(stack, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
        detail: FloatArray = layers[grid.index] - smooth.reshape(layers.shape)[grid.index]
        return detail


def tone_curve(share: FloatArray, light: Light) -> FloatArray:
    """Return the tone curve (n,) between ink (0) and plate (1), at white shares (n,)."""
    arch, lean = share * (1.0 - share), 2.0 * share - 1.0
    tone: FloatArray = share + arch * (light.tone_1 + lean * (light.tone_2 + lean * light.tone_3))
    return tone


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
