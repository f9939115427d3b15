"""From white share to grey value: levels, tone curve, almost even light, sharpening.

    grey = sharpen(sRGB(sharpen((black + (white − black) · tone(x)) · bulge)))
    x = lit · share + (lit − 1) · black / (white − black)
    lit = 1 + slope · offset,    bulge = 1 + curvature · (offset² − ⅝)

x is the light, from ink, 0, to plate, 1; `lit` is its gradient, `bulge` what local tone mapping
leaves. By `tone`, which has three parameters, an unknown response departs from sRGB's curve, which
nearly all cameras follow approximately. The outer sharpening is an unsharp mask on the pixel grid,
after the tone curve as in cameras. The inner one, in linear light, is that of demosaicing; after
the tone curve it shows most on the dark side of edges. In uneven light, x runs between the light on
ink and on plate at each pixel, and processing may change edges alone: `share` becomes share +
edge_tone · share · (1 − share). All of these displace apparent edges; the displacement δ is no
parameter here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto

import numpy as np

from kgcp.geometry._jit import compiled, inlined
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.image_model.blurred_plate import WhiteShare
from kgcp.measurement.image_model.sharpening import Mask
from kgcp.measurement.image_model.srgb import (
    encode_pixels,
    srgb_decoded,
    srgb_encoded,
    srgb_encoded_number,
    srgb_slope,
)


class Tone(Enum):
    """What is known about the curve from light to grey value, and what is estimated.

    "Shaped" curves apply the three tone parameters before their base: sRGB's curve or a line.
    """

    LINEAR = auto()
    SRGB = auto()
    NEAR_SRGB = auto()  # sRGB, shaped a little
    UNKNOWN = auto()  # shaped, over sRGB's curve: usual cameras are close to it
    UNKNOWN_OVER_LINE = auto()  # shaped, over a straight line: some cameras are closer to that
    BINNED = auto()  # shaped, over a line: of a curve, bins of pixels show only how it shifts edges

    @staticmethod
    def of(response: Response) -> Tone:
        """Return the tone of a camera's single pixels."""
        return Tone[response.name]

    @property
    def is_srgb(self) -> bool:
        """Whether sRGB's curve is applied last."""
        # comparing one by one is several times as fast as a set
        return self is Tone.SRGB or self is Tone.NEAR_SRGB or self is Tone.UNKNOWN

    @property
    def is_curved(self) -> bool:
        """Whether the curve is not a straight line, so that noise is not linear in the level."""
        return self in {Tone.SRGB, Tone.NEAR_SRGB} or self.is_unknown

    @property
    def is_unknown(self) -> bool:
        """Whether the curve of single pixels is unknown."""
        return self is Tone.UNKNOWN or self is Tone.UNKNOWN_OVER_LINE

    @property
    def is_shaped(self) -> bool:
        """Whether the three tone parameters are used."""
        return not (self is Tone.LINEAR or self is Tone.SRGB)


class Param(IntEnum):
    """Rows of the Jacobian; the rows 0…5 are those of the pose."""

    BLUR_MEAN = 6
    BLUR_DIFFERENCE = 7
    BLUR_XY = 8
    STREAK_X = 9
    STREAK_Y = 10
    BLACK = 11
    WHITE = 12
    SLOPE_X = 13
    SLOPE_Y = 14
    CURVATURE = 15
    TONE_1 = 16
    TONE_2 = 17
    TONE_3 = 18
    SHARPENING = 19
    LINEAR_SHARPENING = 20
    SKEW_XXX = 21
    SKEW_XXY = 22
    SKEW_XYY = 23
    SKEW_YYY = 24
    KURTOSIS = 25
    EDGE_TONE = 26


PARAM_COUNT = 27
PLAIN_COUNT = 21  # rows without skew and kurtosis of the point spread and without edge tone
# Row numbers for compiled functions; the last two are by the additional light on ink and on plate.
_BLACK, _WHITE, _SLOPE_X, _SLOPE_Y, _CURVATURE = range(Param.BLACK, Param.TONE_1)
_TONE_1, _TONE_2, _TONE_3, _SHARPENING, _LINEAR_SHARPENING = range(Param.TONE_1, PLAIN_COUNT)
_EDGE_TONE, _BY_INK, _BY_PLATE = range(Param.EDGE_TONE, PARAM_COUNT + 2)


@dataclass(frozen=True, slots=True)
class Light:
    """Photometric parameters."""

    # levels of ink and plate before clipping, 1 = full scale
    black: float
    white: float
    # relative gradient of the light per ring radius
    slope_x: float = 0.0
    slope_y: float = 0.0
    # relative increase of the light with the squared distance from the centre, in ring radii
    curvature: float = 0.0
    # shape of the tone curve between black and white; with 0, 0, 0 it is that of its base
    tone_1: float = 0.0
    tone_2: float = 0.0
    tone_3: float = 0.0
    # strength of the unsharp mask after the tone curve, and of the one before it
    sharpening: float = 0.0
    linear_sharpening: float = 0.0
    # Processing that follows the local contrast adds this times share · (1 − share) to the white
    # share. Only if the levels vary; otherwise the tone curve has the same effect.
    edge_tone: float = 0.0

    @property
    def values(self) -> tuple[float, ...]:
        """All eleven values, in the order of `Param`."""
        levels = (self.black, self.white, self.slope_x, self.slope_y, self.curvature)
        tone = (self.tone_1, self.tone_2, self.tone_3)
        return (*levels, *tone, self.sharpening, self.linear_sharpening, self.edge_tone)


def plateau_levels(light: Light, tone: Tone) -> tuple[float, float]:
    """Return the grey values of ink and plate before clipping."""
    if not tone.is_srgb:
        return light.black, light.white
    return srgb_encoded_number(light.black), srgb_encoded_number(light.white)


def encoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return the grey values of light, by sRGB's curve or a straight line."""
    return srgb_encoded(level) if tone.is_srgb else level


def _encoded_pixels(level: FloatArray, tone: Tone) -> FloatArray:
    """Return the same as `encoded` for many pixels (n,), in less time."""
    return encode_pixels(level, np.empty(len(level))) if tone.is_srgb else level


def decoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return the light that gives grey values, by sRGB's curve or a straight line."""
    return srgb_decoded(level) if tone.is_srgb else level


def light_of_levels(black: float, white: float, tone: Tone) -> Light:
    """Return even light in which ink and plate have these grey values."""
    if tone.is_srgb:
        black, white = (float(level) for level in srgb_decoded(np.array([black, white])))
    return Light(black, white)


# Gradient and curvature are not sharpened, to save time. Their rows are off by 30 % at some edges,
# which moves poses by less than 0.04 σ and changes deviations by 1 % (sharpened rings, R 14–28 px).
_SHARPENED_ROWS = [Param.BLACK, Param.WHITE, *range(9)]
_TONE_ROWS = [Param.TONE_1, Param.TONE_2, Param.TONE_3]
_LEVEL_ROWS = [Param.BLACK, Param.WHITE, *_TONE_ROWS]
SKEW_PARAMS = [int(Param.SKEW_XXX), int(Param.SKEW_XXY), int(Param.SKEW_XYY), int(Param.SKEW_YYY)]
SHAPE_PARAMS = [*SKEW_PARAMS, int(Param.KURTOSIS)]  # deviations of the point spread from a Gaussian
_RARE_ROWS = np.array([Param.STREAK_X, Param.STREAK_Y, *SHAPE_PARAMS, Param.EDGE_TONE])
_SHARE_STEPS = 400  # between ink and plate, in `_first_share_above`
_CURVE_STEPS = 64  # between ink and plate, in `light_over_base`
GEOMETRY_ROWS = 11  # of pose and blur, without skew and kurtosis
_CURVED_BELOW, _CURVED_ABOVE = 0.05, 0.1  # farther beyond ink and plate, the tone curve is straight
_MEAN_SQUARE = 0.625  # mean squared distance of both edges from the centre, in ring radii
# Newton's method along the tone curve diverges where that is flatter, or with longer steps.
_NEWTON_STEPS, _MIN_SLOPE, _MAX_STEP = 4, 0.1, 0.3
_NO_ADDED_LIGHT = np.zeros((2, 1))  # for all pixels
_NO_VALUES = np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class PhotometricModel:
    """Relation of white share to grey value, for the n pixels of one sample."""

    offsets: FloatArray  # (2, n): from the target's centre, in ring radii
    tone: Tone
    mask: Mask | None  # of the camera's sharpening; None if it does not sharpen

    def levels(
        self, share: FloatArray, light: Light, added: FloatArray | None = None
    ) -> FloatArray:
        """Return the modelled grey values (n,) before clipping.

        `added` (2, n) is the additional light on ink and plate at every pixel, over their contrast.
        """
        value = np.empty(len(share))
        _expose(share, self.offsets, light.values, self._added(added), value)
        mask = self._linear_mask(added)
        if mask is not None and light.linear_sharpening:
            detail = mask.detail(value, light.black, light.white)
            value += light.linear_sharpening * detail
        value = _encoded_pixels(value, self.tone)
        if self.mask is None:
            return value
        return value + light.sharpening * self._detail(self.mask, value, light, added)

    def level_changes(
        self, share: FloatArray, light: Light, rows: FloatArray, added: FloatArray | None = None
    ) -> FloatArray:
        """Return the first-order changes (k, n) of the levels due to changes of the share.

        `rows` (k, n) are the changes of the share; `added` is as in `levels`.
        """
        value, values = np.empty(len(share)), light.values
        _expose(share, self.offsets, values, self._added(added), value)
        lit, bulge = _light_at(self.offsets, values)
        ink, between = (0.0, 1.0) if added is None else (added[0], 1.0 + added[1] - added[0])
        bent = share + light.edge_tone * share * (1.0 - share)
        by_share = 1.0 + light.edge_tone * (1.0 - 2.0 * share)
        x = lit * (ink + between * bent) + (lit - 1.0) * light.black / (light.white - light.black)
        by_light = _tone_curve_derivatives(x, values)[-1]
        carried: FloatArray = bulge * lit * between * by_light * by_share * rows
        mask = self._linear_mask(added)
        if mask is not None and light.linear_sharpening:
            value += light.linear_sharpening * mask.detail(value, light.black, light.white)
            for k in range(len(carried)):
                carried[k] += light.linear_sharpening * mask.detail(carried[k], 0.0, 0.0)
        if self.tone.is_srgb:
            slope = np.empty(len(value))
            encode_pixels(value, slope)
            carried *= slope
        if self.mask is not None:
            for k in range(len(carried)):
                carried[k] += light.sharpening * self.mask.detail(carried[k], 0.0, 0.0)
        return carried

    def local_levels(self, light: Light, added: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the levels of ink and of plate at every pixel in uneven light, each (n,)."""
        ink, plate = apply_tone(added[0], light.values), apply_tone(1.0 + added[1], light.values)
        return _encoded_pixels(ink, self.tone), _encoded_pixels(plate, self.tone)

    def _linear_mask(self, added: FloatArray | None) -> Mask | None:
        """Return the mask of the sharpening before the tone curve; None if there is none.

        Over a straight line, sharpening before the curve would be the same as after it. In uneven
        light it is not estimated (`without_even_light`).
        """
        return self.mask if self.tone is Tone.UNKNOWN and added is None else None

    def _sharpen_levels(
        self, mask: Mask, jacobian: FloatArray, light: Light, added: FloatArray
    ) -> None:
        """Complete the sharpened derivatives in uneven light.

        Those by the added light are sharpened. Those by levels and tone curve get the contribution
        of pixels that are not modelled, each of which has its own level.
        """
        ink, plate = (self._level_slopes(x, light) for x in (added[0], 1.0 + added[1]))
        for k, row in enumerate(_LEVEL_ROWS if self.tone.is_shaped else _LEVEL_ROWS[:2]):
            jacobian[row] -= light.sharpening * (mask.ink * ink[k] + mask.plate * plate[k])
        by_ink, by_plate = jacobian[PARAM_COUNT], jacobian[PARAM_COUNT + 1]
        by_ink += light.sharpening * mask.detail(by_ink, ink[-1], 0.0)
        by_plate += light.sharpening * mask.detail(by_plate, 0.0, plate[-1])

    def _level_slopes(self, x: FloatArray, light: Light) -> FloatArray:
        """Return the derivatives (6, n) of grey values by `_LEVEL_ROWS` and by the light x."""
        slopes = _tone_curve_derivatives(x, light.values)
        if self.tone.is_srgb:
            curve_slope = np.empty(len(x))
            encode_pixels(apply_tone(x, light.values), curve_slope)
            slopes *= curve_slope
        return slopes

    def _added(self, added: FloatArray | None) -> FloatArray:
        return _NO_ADDED_LIGHT if added is None else added

    def linearised(
        self, share: WhiteShare, light: Light, added: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) and their Jacobian; `added` is as in `levels`.

        The Jacobian has 21 rows, or 27 if the share has derivatives by skew and kurtosis. In uneven
        light it has 29 rows; the last two are by the added light on ink and on plate.
        """
        value = np.empty(len(share.value))
        has_shape = len(share.jacobian) > GEOMETRY_ROWS
        rows = PARAM_COUNT if has_shape or added is not None else PLAIN_COUNT
        jacobian = np.empty((rows + (0 if added is None else 2), len(value)))
        _expose_with_derivatives(
            share.value,
            share.jacobian,
            self.offsets,
            light.values,
            self._added(added),
            self.tone.is_shaped,
            value,
            jacobian,
        )
        in_light, detail, slope = self._linear_mask(added), None, None
        if in_light is not None:
            detail = in_light.detail(value, light.black, light.white)
            value += light.linear_sharpening * detail
        if self.tone.is_srgb:
            slope = np.empty(len(value))
            value = encode_pixels(value, slope)
        if self.mask is None:
            if slope is not None:
                jacobian *= slope
            return value, jacobian
        self._sharpen(self.mask, jacobian, light, added, detail, slope)
        if added is not None:
            self._sharpen_levels(self.mask, jacobian, light, added)
        detail = self._detail(self.mask, value, light, added)
        jacobian[Param.SHARPENING] = detail
        return value + light.sharpening * detail, jacobian

    def _detail(
        self, mask: Mask, value: FloatArray, light: Light, added: FloatArray | None
    ) -> FloatArray:
        """Return what the mask adds to the grey values at a strength of 1.

        Pixels not modelled are far from edges: pure ink or plate, without the light's gradient.
        """
        if added is None:
            return mask.detail(value, *plateau_levels(light, self.tone))
        ink, plate = self.local_levels(light, added)
        return mask.detail(value, ink, plate)

    def _sharpen(
        self,
        mask: Mask,
        jacobian: FloatArray,
        light: Light,
        added: FloatArray | None,
        detail: FloatArray | None,
        slope: FloatArray | None,
    ) -> None:
        """Sharpen rows of a Jacobian in linear light, convert them to grey values, sharpen again.

        `detail` is what the mask adds in linear light at a strength of 1; None: it is not used
        there. `slope` is that of sRGB's curve; None: the curve is not applied.
        """
        rows, in_light = [*_SHARPENED_ROWS], (0.0, _NO_VALUES)
        if self.tone.is_shaped:
            rows += _TONE_ROWS
        if detail is not None:
            rows.append(Param.LINEAR_SHARPENING)
            in_light = light.linear_sharpening, detail
        others = (1.0, 1.0)
        if added is not None:  # `_sharpen_levels` adds their contribution
            others = (0.0, 0.0)
        elif slope is not None:
            ink, plate = srgb_slope(np.array([light.black, light.white])).tolist()
            others = (ink, plate)
        mask.sharpen_around_curve(
            jacobian,
            np.array(rows),
            _RARE_ROWS,
            in_light,
            _NO_VALUES if slope is None else slope,
            others,
            light.sharpening,
        )


def undo_edge_tone(bent: FloatArray, light: Light) -> FloatArray:
    """Return the white share (n,) that the edge tone has changed to `bent` (n,)."""
    at_ink = 1.0 + light.edge_tone  # slope of `bent` at a share of 0
    root = np.sqrt(np.maximum(at_ink * at_ink - 4.0 * light.edge_tone * bent, 0.0))
    return np.asarray(2.0 * bent / (at_ink + root))


def share_at_level(level: float, light: Light, tone: Tone) -> float:
    """Return the white share, 0…1, at which a grey value is reached in even light."""
    return _first_share_above(float(decoded(np.array(level), tone)), light.values)


@inlined
def _tone_curve(
    x: float, tone_1: float, tone_2: float, tone_3: float
) -> tuple[float, float, float, float, float]:
    """Return the tone curve at light x, its slope, and its derivatives by the three parameters."""
    within = min(max(x, -_CURVED_BELOW), 1.0 + _CURVED_ABOVE)
    beyond, arch, lean = x - within, within * (1.0 - within), 2.0 * within - 1.0
    tone = within + arch * (tone_1 + lean * (tone_2 + lean * tone_3))
    slope_2, slope_3 = 6.0 * arch - 1.0, lean * (8.0 * arch - 1.0)
    slope = 1.0 - tone_1 * lean
    slope += tone_2 * slope_2 + tone_3 * slope_3
    by_1, by_2 = arch - beyond * lean, arch * lean + beyond * slope_2
    by_3 = arch * lean * lean + beyond * slope_3
    return tone + slope * beyond, slope, by_1, by_2, by_3


@inlined
def _edge_toned(share: float, edge_tone: float) -> tuple[float, float]:
    """Return the white share changed by the edge tone, and its derivative by the share."""
    return share + edge_tone * share * (1.0 - share), 1.0 + edge_tone * (1.0 - 2.0 * share)


@compiled
def _first_share_above(level: float, light: tuple[float, ...]) -> float:
    """Return the first share at which a level is exceeded; on a grid of 1/400, interpolated."""
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, _ = light
    highest = black
    if level < highest:
        return 0.0
    for k in range(1, _SHARE_STEPS + 1):
        t = k / _SHARE_STEPS
        tone, _, _, _, _ = _tone_curve(t, tone_1, tone_2, tone_3)
        grey = black + (white - black) * tone
        if grey > level:
            return (k - 1 + (level - highest) / (grey - highest)) / _SHARE_STEPS
        highest = max(highest, grey)
    return 1.0


@compiled
def apply_tone(x: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the levels (n,) of light x (n,), from ink, 0, to plate, 1, before a base curve."""
    level = np.empty(len(x))
    for i in range(len(x)):
        tone, _, _, _, _ = _tone_curve(x[i], light[5], light[6], light[7])
        level[i] = light[0] + (light[1] - light[0]) * tone
    return level


def apply_tone_uncompiled(share: FloatArray, light: Light) -> FloatArray:
    """Return the same as `apply_tone` for x from 0 to 1, without loading compiled code."""
    arch, lean = share * (1.0 - share), 2.0 * share - 1.0
    tone = share + arch * (light.tone_1 + lean * (light.tone_2 + lean * light.tone_3))
    return np.asarray(light.black + (light.white - light.black) * tone)


def light_over_base(light: Light, tone: Tone, other: Tone) -> Light:
    """Return the light that has nearly the same grey values over another base of the tone curve.

    The grey values of ink and plate stay the same. Between them, the three tone parameters are
    fitted by least squares in the light.
    """
    share = np.linspace(0.0, 1.0, _CURVE_STEPS + 1)
    level = decoded(encoded(apply_tone_uncompiled(share, light), tone), other)
    black, white = level[0], level[-1]
    bend = (level - black) / (white - black) - share
    shapes = share * (1.0 - share) * (2.0 * share - 1.0) ** np.arange(3)[:, None]
    tone_1, tone_2, tone_3 = np.linalg.lstsq(shapes.T, bend)[0].tolist()
    return replace(
        light,
        black=float(black),
        white=float(white),
        tone_1=tone_1,
        tone_2=tone_2,
        tone_3=tone_3,
    )


@compiled
def _tone_curve_derivatives(x: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the derivatives (6, n) of `apply_tone` by ink, plate, the tone parameters and x."""
    slopes, contrast = np.empty((6, len(x))), light[1] - light[0]
    for i in range(len(x)):
        tone, slope, by_1, by_2, by_3 = _tone_curve(x[i], light[5], light[6], light[7])
        slopes[0, i], slopes[1, i] = 1.0 - tone, tone
        slopes[2, i], slopes[3, i], slopes[4, i] = contrast * by_1, contrast * by_2, contrast * by_3
        slopes[5, i] = contrast * slope
    return slopes


@compiled
def light_after_step(
    x: FloatArray, step: FloatArray, before: tuple[float, ...], after: tuple[float, ...]
) -> FloatArray:
    """Return the light x (n,) after a step of x and of `Light`, so that levels change linearly.

    The step predicts levels to first order. x is chosen so that the curve after the step gives just
    these levels; where that curve is too flat, x is simply moved by its step.
    """
    moved, contrast = np.empty(len(x)), after[1] - after[0]
    for i in range(len(x)):
        tone, slope, by_1, by_2, by_3 = _tone_curve(x[i], before[5], before[6], before[7])
        shape = tone + slope * step[i] + by_1 * (after[5] - before[5])
        shape += by_2 * (after[6] - before[6]) + by_3 * (after[7] - before[7])
        level = before[0] + (before[1] - before[0]) * shape
        level += (1.0 - tone) * (after[0] - before[0]) + tone * (after[1] - before[1])
        goal, at, is_steep = (level - after[0]) / contrast, x[i] + step[i], True
        for _ in range(_NEWTON_STEPS):
            tone, slope, _, _, _ = _tone_curve(at, after[5], after[6], after[7])
            is_steep &= slope > _MIN_SLOPE
            at += min(max((goal - tone) / max(slope, _MIN_SLOPE), -_MAX_STEP), _MAX_STEP)
        moved[i] = at if is_steep else x[i] + step[i]
    return moved


@inlined
def _lit(x: float, y: float, light: tuple[float, ...]) -> tuple[float, float, float]:
    """Return `lit` and `bulge` of the model at a place in ring radii, and bulge's derivative.

    ⅝ is the mean of offset² over both edges, (1² + ½²)/2 for an inner radius of ½: so the curvature
    is not mistaken for the level of white.
    """
    by_curvature = x * x + y * y - _MEAN_SQUARE
    return 1.0 + light[2] * x + light[3] * y, 1.0 + light[4] * by_curvature, by_curvature


@compiled
def _light_at(offsets: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return `lit` and `bulge` of the model (2, n) at all pixels."""
    lit = np.empty((2, offsets.shape[1]))
    for i in range(lit.shape[1]):
        lit[0, i], lit[1, i], _ = _lit(offsets[0, i], offsets[1, i], light)
    return lit


@compiled
def _expose(
    share: FloatArray,
    offsets: FloatArray,
    light: tuple[float, ...],
    added: FloatArray,
    value: FloatArray,
) -> None:
    """Fill in (black + (white − black) · tone(x)) · bulge; see the module's docstring."""
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, edge_tone = light
    stride = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, stride * i], 1.0 + added[1, stride * i]
        lit, bulge, _ = _lit(offsets[0, i], offsets[1, i], light)
        bent, _ = _edge_toned(share[i], edge_tone)
        x = lit * (ink + (plate - ink) * bent) + (lit - 1.0) * black / (white - black)
        tone, _, _, _, _ = _tone_curve(x, tone_1, tone_2, tone_3)
        value[i] = bulge * (black + (white - black) * tone)


@compiled
def _expose_with_derivatives(
    share: FloatArray,
    by_geometry: FloatArray,
    offsets: FloatArray,
    light: tuple[float, ...],
    added: FloatArray,
    has_tone: bool,  # noqa: FBT001 - compiled functions have no keywords
    value: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Fill in the values of `_expose` and the Jacobian, in the order of `Param`.

    `by_geometry` (11 or 16, n) are those of the share. In uneven light, those by the added light on
    ink and plate follow.
    """
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, edge_tone = light
    contrast, gains = white - black, np.empty(len(share))
    has_shape = by_geometry.shape[0] > GEOMETRY_ROWS
    stride = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, stride * i], 1.0 + added[1, stride * i]
        right, down = offsets[0, i], offsets[1, i]
        lit, bulge, by_curvature = _lit(right, down, light)
        bent, by_share = _edge_toned(share[i], edge_tone)
        x = ink + (plate - ink) * bent
        tone, slope, by_1, by_2, by_3 = _tone_curve(
            lit * x + (lit - 1.0) * black / contrast, tone_1, tone_2, tone_3
        )
        core = black + contrast * tone
        value[i] = bulge * core
        gain = bulge * contrast * lit
        gains[i] = gain * slope * (plate - ink) * by_share
        of_ink_light = slope * (lit - 1.0) / contrast  # x contains black / contrast
        jacobian[_BLACK, i] = bulge * (1.0 - tone + of_ink_light * white)
        jacobian[_WHITE, i] = bulge * (tone - of_ink_light * black)
        by_light = bulge * slope * (black + contrast * x)
        jacobian[_SLOPE_X, i], jacobian[_SLOPE_Y, i] = by_light * right, by_light * down
        bend = bulge * contrast if has_tone else 0.0
        jacobian[_CURVATURE, i] = core * by_curvature
        jacobian[_TONE_1, i], jacobian[_TONE_2, i] = bend * by_1, bend * by_2
        jacobian[_TONE_3, i] = bend * by_3
        jacobian[_SHARPENING, i] = jacobian[_LINEAR_SHARPENING, i] = 0.0
        if len(jacobian) > _EDGE_TONE:
            jacobian[_EDGE_TONE, i] = 0.0
        if stride:
            jacobian[_EDGE_TONE, i] = gain * slope * (plate - ink) * share[i] * (1.0 - share[i])
            jacobian[_BY_INK, i] = gain * slope * (1.0 - bent)
            jacobian[_BY_PLATE, i] = gain * slope * bent
    for k in range(PLAIN_COUNT, min(_EDGE_TONE, len(jacobian))):
        row = k - PLAIN_COUNT + GEOMETRY_ROWS
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_geometry[row, i] if has_shape else 0.0
    for k in range(GEOMETRY_ROWS):
        for i in range(len(share)):
            jacobian[k, i] = gains[i] * by_geometry[k, i]
