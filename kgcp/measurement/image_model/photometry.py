"""From white share to grey value: levels, tone, a lit gradient, in-camera sharpening.

grey = sharpen(sRGB((black + (white − black) · tone(share)) · (1 + slope · offset))): an unknown
response departs from sRGB's curve, which nearly all cameras follow, by a function of the share
between ink and plate that has three parameters; sharpening is an unsharp mask on the pixel grid,
after the tone curve as in cameras. Together they are what displaces apparent edges: δ is a
consequence here, not a parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum, auto

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.sharpening import Mask


class Tone(Enum):
    """What is known of the curve between light and grey value, and what is free."""

    LINEAR = auto()
    SRGB = auto()
    UNKNOWN = auto()  # sRGB, of light that three parameters shape: usual cameras are near it
    UNKNOWN_FROM_LINE = auto()  # the same over a straight line: some curves are nearer to that
    OF_BINS = auto()  # a straight line that they shape: bins leave of a curve what displaces edges

    @staticmethod
    def of(response: Response) -> Tone:
        """Return the tone of pixels of a camera."""
        return Tone[response.name]

    @property
    def is_srgb(self) -> bool:
        """Whether sRGB's curve is applied last."""
        return self in {Tone.SRGB, Tone.UNKNOWN}

    @property
    def is_shaped(self) -> bool:
        """Whether the tone parameters take part."""
        return self in {Tone.UNKNOWN, Tone.UNKNOWN_FROM_LINE, Tone.OF_BINS}


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
    SKEW_XXX = 19
    SKEW_XXY = 20
    SKEW_XYY = 21
    SKEW_YYY = 22


PARAM_COUNT = 23
PLAIN_COUNT = 19  # without the skew


@dataclass(frozen=True, slots=True)
class Light:
    """Photometric parameters."""

    # levels of ink and plate before clipping, 1 = full scale
    black: float
    white: float
    # relative gradient of the light over one ring radius
    slope_x: float = 0.0
    slope_y: float = 0.0
    # shape of an unknown tone curve between black and white; 0, 0, 0 is linear
    tone_1: float = 0.0
    tone_2: float = 0.0
    tone_3: float = 0.0
    sharpening: float = 0.0  # strength of the unsharp mask

    @property
    def values(self) -> tuple[float, ...]:
        """All eight, in the order of `Param`."""
        levels = (self.black, self.white, self.slope_x, self.slope_y)
        return (*levels, self.tone_1, self.tone_2, self.tone_3, self.sharpening)


def plateau_levels(light: Light, tone: Tone) -> tuple[float, float]:
    """Return the grey values of ink and plate before clipping.

    Without sRGB's curve they are the light's own levels.
    """
    if not tone.is_srgb:
        return light.black, light.white
    black, white = srgb_encoded(np.array([light.black, light.white])).tolist()
    return black, white


def encoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return grey values from light, by sRGB's curve or a straight line."""
    return srgb_encoded(level) if tone.is_srgb else level


def decoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return the light that gives grey values, by sRGB's curve or a straight line."""
    return srgb_decoded(level) if tone.is_srgb else level


def light_of_levels(black: float, white: float, tone: Tone) -> Light:
    """Return the light that gives these grey values of ink and plate."""
    if tone.is_srgb:
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
SKEW_PARAMS = [int(Param.SKEW_XXX), int(Param.SKEW_XXY), int(Param.SKEW_XYY), int(Param.SKEW_YYY)]
_SHARE_STEPS = 400
GEOMETRY_ROWS = 11  # of pose and blur, without the skew
# Beyond ink and plate, where curves still follow their formula; light in shade is mostly between.
_CURVED_BELOW, _CURVED_ABOVE = 0.05, 0.1
_NOTHING = np.zeros((2, 1))  # added to the levels of all pixels


@dataclass(frozen=True, slots=True, eq=False)
class PhotometricModel:
    """Relation of white share to grey value, for the n pixels of one sample."""

    offsets: FloatArray  # (2, n): from the target's centre, in ring radii
    # `linear` and `srgb` are applied as known; `unknown` uses the tone parameters
    tone: Tone
    mask: Mask | None  # of the camera's sharpening; None: it does not sharpen

    def levels(
        self, share: FloatArray, light: Light, added: FloatArray | None = None
    ) -> FloatArray:
        """Return the modelled grey values (n,) before clipping.

        `added` (2, n) is the additional light on ink and plate at every pixel, of their contrast.
        """
        value = np.empty(len(share))
        _expose(share, self.offsets, light.values, self._added(added), value)
        value = encoded(value, self.tone)
        if self.mask is None:
            return value
        return value + light.sharpening * self._detail(self.mask, value, light, added)

    def slopes(self, share: FloatArray, light: Light) -> FloatArray:
        """Return the derivatives (n,) of the levels by the share, in even light, unsharpened."""
        slopes, values = _tone_slopes(share, light.values), light.values
        slopes *= 1.0 + values[2] * self.offsets[0] + values[3] * self.offsets[1]
        if self.tone.is_srgb:
            value = np.empty(len(share))
            _expose(share, self.offsets, values, _NOTHING, value)
            slopes *= srgb_slope(value)
        return slopes

    def local_levels(self, light: Light, added: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the levels of ink and of plate at all pixels, where the light is uneven."""
        ink, plate = toned(added[0], light.values), toned(1.0 + added[1], light.values)
        return encoded(ink, self.tone), encoded(plate, self.tone)

    def _sharpen_levels(
        self, mask: Mask, jacobian: FloatArray, light: Light, added: FloatArray
    ) -> None:
        """Sharpen the derivatives by what is added to ink and to plate."""
        ink, plate = (_tone_slopes(x, light.values) for x in (added[0], 1.0 + added[1]))
        if self.tone.is_srgb:
            ink *= srgb_slope(toned(added[0], light.values))
            plate *= srgb_slope(toned(1.0 + added[1], light.values))
        by_ink, by_plate = jacobian[PARAM_COUNT], jacobian[PARAM_COUNT + 1]
        by_ink += light.sharpening * mask.detail(by_ink, ink, 0.0)
        by_plate += light.sharpening * mask.detail(by_plate, 0.0, plate)

    def _added(self, added: FloatArray | None) -> FloatArray:
        return _NOTHING if added is None else added

    def linearised(
        self, share: WhiteShare, light: Light, added: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) and their Jacobian; `added` as in `levels`.

        It has 19 rows, or 23 where the point spread is skew. Where the light is uneven it has 25,
        the last two by what is added to ink and to plate.
        """
        value = np.empty(len(share.value))
        has_skew = len(share.jacobian) > GEOMETRY_ROWS
        rows = PARAM_COUNT if has_skew or added is not None else PLAIN_COUNT
        jacobian = np.empty((rows + (0 if added is None else 2), len(value)))
        has_tone = self.tone.is_shaped
        _expose_with_slopes(
            share.value,
            share.jacobian,
            self.offsets,
            light.values,
            self._added(added),
            has_tone,
            value,
            jacobian,
        )
        if self.tone.is_srgb:
            jacobian *= srgb_slope(value)
            value = encoded(value, self.tone)
        if self.mask is None:
            return value, jacobian
        if added is not None:
            self._sharpen_levels(self.mask, jacobian, light, added)
        self._sharpen(self.mask, jacobian, light)
        detail = self._detail(self.mask, value, light, added)
        jacobian[Param.SHARPENING] = detail
        return value + light.sharpening * detail, jacobian

    def _detail(
        self, mask: Mask, value: FloatArray, light: Light, added: FloatArray | None
    ) -> FloatArray:
        """Return what the mask adds to the grey values at full strength.

        Where no edge is near there is no blur, and over the mask the light's gradient is flat.
        """
        if added is None:
            return mask.detail(value, *plateau_levels(light, self.tone))
        ink, plate = self.local_levels(light, added)
        return mask.detail(value, ink, plate)

    def _sharpen(self, mask: Mask, jacobian: FloatArray, light: Light) -> None:
        """Sharpen the rows of a Jacobian."""
        rows = [*_FILTERED, *(_TONE_ROWS if self.tone.is_shaped else [])]
        if jacobian[Param.STREAK_X].any() or jacobian[Param.STREAK_Y].any():
            rows += _STREAK_ROWS
        if len(jacobian) > PLAIN_COUNT and jacobian[Param.SKEW_XXX].any():
            for row in SKEW_PARAMS:
                jacobian[row] += light.sharpening * mask.detail(jacobian[row], 0.0, 0.0)
        others = (1.0, 1.0)
        if self.tone.is_srgb:
            ink, plate = srgb_slope(np.array([light.black, light.white])).tolist()
            others = (ink, plate)
        mask.sharpen(jacobian, np.array(rows), others, light.sharpening)


def share_at(level: float, light: Light, tone: Tone) -> float:
    """Return the white share at which a grey value is reached, 0…1; without a gradient of light."""
    return _share_at(float(decoded(np.array(level), tone)), light.values)


@inlined
def _toned(
    x: float, tone_1: float, tone_2: float, tone_3: float
) -> tuple[float, float, float, float]:
    """Return the tone curve at a share x, its slope, arch and lean.

    The derivatives by the three tone parameters are arch, arch · lean and arch · lean² where the
    curve follows its formula, and nearly so beyond, where it goes on straight.
    """
    within = min(max(x, -_CURVED_BELOW), 1.0 + _CURVED_ABOVE)
    arch, lean = within * (1.0 - within), 2.0 * within - 1.0
    tone = within + arch * (tone_1 + lean * (tone_2 + lean * tone_3))
    slope = 1.0 - tone_1 * lean
    slope += tone_2 * (6.0 * arch - 1.0) + tone_3 * lean * (8.0 * arch - 1.0)
    return tone + slope * (x - within), slope, arch, lean


@compiled
def _share_at(level: float, light: tuple[float, ...]) -> float:
    """Return where between ink and plate a level is first passed for good, by steps of 1/400."""
    black, white, _, _, tone_1, tone_2, tone_3, _ = light
    highest = black
    if level < highest:
        return 0.0
    for k in range(1, _SHARE_STEPS + 1):
        t = k / _SHARE_STEPS
        tone, _, _, _ = _toned(t, tone_1, tone_2, tone_3)
        grey = black + (white - black) * tone
        if grey > level:
            return (k - 1 + (level - highest) / (grey - highest)) / _SHARE_STEPS
        highest = max(highest, grey)
    return 1.0


@compiled
def toned(x: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the levels, before a known encoding, of light between that of ink, 0, and plate, 1."""
    level = np.empty(len(x))
    for i in range(len(x)):
        tone, _, _, _ = _toned(x[i], light[4], light[5], light[6])
        level[i] = light[0] + (light[1] - light[0]) * tone
    return level


@compiled
def _tone_slopes(x: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the derivatives of `toned`."""
    slopes = np.empty(len(x))
    for i in range(len(x)):
        _, slope, _, _ = _toned(x[i], light[4], light[5], light[6])
        slopes[i] = (light[1] - light[0]) * slope
    return slopes


@compiled
def _expose(
    share: FloatArray,
    offsets: FloatArray,
    light: tuple[float, ...],
    added: FloatArray,
    value: FloatArray,
) -> None:
    """Fill in black + (white − black) · tone(share), times the gradient of the light."""
    black, white, slope_x, slope_y, tone_1, tone_2, tone_3, _ = light
    each = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, each * i], 1.0 + added[1, each * i]
        tone, _, _, _ = _toned(ink + (plate - ink) * share[i], tone_1, tone_2, tone_3)
        lit = 1.0 + slope_x * offsets[0, i] + slope_y * offsets[1, i]
        value[i] = (black + (white - black) * tone) * lit


@compiled
def _expose_with_slopes(
    share: FloatArray,
    by_geometry: FloatArray,
    offsets: FloatArray,
    light: tuple[float, ...],
    added: FloatArray,
    has_tone: bool,  # noqa: FBT001 - compiled functions have no keywords
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Extend `_expose` by derivatives: by geometry (11 or 15, n), then in the order of `Param`.

    Where the light is uneven, those by what is added to ink and to plate follow.
    """
    black, white, slope_x, slope_y, tone_1, tone_2, tone_3, _ = light
    contrast, gains = white - black, np.empty(len(share))
    has_skew = by_geometry.shape[0] > 11
    each = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, each * i], 1.0 + added[1, each * i]
        x = ink + (plate - ink) * share[i]
        tone, slope, arch, lean = _toned(x, tone_1, tone_2, tone_3)
        lit = 1.0 + slope_x * offsets[0, i] + slope_y * offsets[1, i]
        core = black + contrast * tone
        value[i] = core * lit
        gain = contrast * lit
        gains[i] = gain * slope * (plate - ink)
        jacobian[11, i] = lit * (1.0 - tone)
        jacobian[12, i] = lit * tone
        jacobian[13, i], jacobian[14, i] = core * offsets[0, i], core * offsets[1, i]
        bend = gain * arch if has_tone else 0.0
        jacobian[15, i], jacobian[16, i], jacobian[17, i] = bend, bend * lean, bend * lean * lean
        jacobian[18, i] = 0.0
        if each:
            jacobian[23, i] = gain * slope * (1.0 - share[i])
            jacobian[24, i] = gain * slope * share[i]
    for k in range(19, min(23, len(jacobian))):
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_geometry[k - 8, i] if has_skew else 0.0
    for k in range(11):
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_geometry[k, i]
