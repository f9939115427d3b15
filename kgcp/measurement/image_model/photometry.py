"""From white share to grey value: levels, tone, light that is not quite even, sharpening.

grey = sharpen(sRGB(sharpen((black + (white − black) · tone(x)) · curved))), where x is the light
between that of ink, 0, and of plate, 1: x = lit · share + (lit − 1) · black / (white − black). Its
gradient is lit = 1 + slope · offset; local tone mapping leaves curved = 1 + curvature · (offset² −
⅝). An unknown response departs from sRGB's curve, which nearly all cameras follow, by a function of
x that has three parameters; sharpening is an unsharp mask on the pixel grid, after the tone curve
as in cameras. Demosaicing sharpens, too, and before the tone curve: behind it, that shows most on
the dark side of edges. Together they are what displaces apparent edges: δ is a consequence here,
not a parameter. In uneven light, processing may bend edges alone: in place of the share, x then has
share + edge_tone · share · (1 − share).
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
    """What is known of the curve between light and grey value, and what is free."""

    LINEAR = auto()
    SRGB = auto()
    NEAR_SRGB = auto()  # sRGB, of light that three parameters shape a little
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
        # comparing one by one is several times as fast as a set
        return self is Tone.SRGB or self is Tone.NEAR_SRGB or self is Tone.UNKNOWN

    @property
    def is_curved(self) -> bool:
        """Whether a curve lies between light and level, so that noise does not grow evenly."""
        return self in {Tone.SRGB, Tone.NEAR_SRGB} or self.is_unknown

    @property
    def is_unknown(self) -> bool:
        """Whether nothing is known of the curve, and single pixels are seen through it."""
        return self is Tone.UNKNOWN or self is Tone.UNKNOWN_FROM_LINE

    @property
    def is_shaped(self) -> bool:
        """Whether the tone parameters take part."""
        return not (self is Tone.LINEAR or self is Tone.SRGB)


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
PLAIN_COUNT = 21  # without the shape of the point spread and the tone of edges
# The rows as numbers, for compiled functions; the last two are by what uneven light adds.
_BLACK, _WHITE, _SLOPE_X, _SLOPE_Y, _CURVATURE = range(Param.BLACK, Param.TONE_1)
_TONE_1, _TONE_2, _TONE_3, _SHARPENING, _LINEAR_SHARPENING = range(Param.TONE_1, PLAIN_COUNT)
_EDGE_TONE, _BY_INK, _BY_PLATE = range(Param.EDGE_TONE, PARAM_COUNT + 2)


@dataclass(frozen=True, slots=True)
class Light:
    """Photometric parameters."""

    # levels of ink and plate before clipping, 1 = full scale
    black: float
    white: float
    # relative gradient of the light over one ring radius
    slope_x: float = 0.0
    slope_y: float = 0.0
    # relative growth of the light with the square of the distance from the centre, in ring radii
    curvature: float = 0.0
    # shape of an unknown tone curve between black and white; 0, 0, 0 is linear
    tone_1: float = 0.0
    tone_2: float = 0.0
    tone_3: float = 0.0
    # strength of the unsharp mask after the tone curve, and of the one before it
    sharpening: float = 0.0
    linear_sharpening: float = 0.0
    # by which the white share is raised at edges, as far as processing follows the local contrast:
    # of share · (1 − share). Only beside levels that vary; otherwise the tone curve does the same.
    edge_tone: float = 0.0

    @property
    def values(self) -> tuple[float, ...]:
        """All eleven, in the order of `Param`."""
        levels = (self.black, self.white, self.slope_x, self.slope_y, self.curvature)
        tone = (self.tone_1, self.tone_2, self.tone_3)
        return (*levels, *tone, self.sharpening, self.linear_sharpening, self.edge_tone)


def plateau_levels(light: Light, tone: Tone) -> tuple[float, float]:
    """Return the grey values of ink and plate before clipping.

    Without sRGB's curve they are the light's own levels.
    """
    if not tone.is_srgb:
        return light.black, light.white
    return srgb_encoded_number(light.black), srgb_encoded_number(light.white)


def encoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return grey values from light, by sRGB's curve or a straight line."""
    return srgb_encoded(level) if tone.is_srgb else level


def _encoded_pixels(level: FloatArray, tone: Tone) -> FloatArray:
    """Return what `encoded` does, of many pixels (n,) in less time."""
    return encode_pixels(level, np.empty(len(level))) if tone.is_srgb else level


def decoded(level: FloatArray, tone: Tone) -> FloatArray:
    """Return the light that gives grey values, by sRGB's curve or a straight line."""
    return srgb_decoded(level) if tone.is_srgb else level


def light_of_levels(black: float, white: float, tone: Tone) -> Light:
    """Return the light that gives these grey values of ink and plate."""
    if tone.is_srgb:
        black, white = (float(level) for level in srgb_decoded(np.array([black, white])))
    return Light(black, white)


# Gradient and curvature are left out, to save time: their rows are off by 30 % at some edges, which
# moves poses by less than 0.04 σ and changes deviations by 1 % (sharpened rings of R 14 to 28 px).
_FILTERED = [Param.BLACK, Param.WHITE, *range(9)]
_TONE_ROWS = [Param.TONE_1, Param.TONE_2, Param.TONE_3]
_LEVEL_ROWS = [Param.BLACK, Param.WHITE, *_TONE_ROWS]
SKEW_PARAMS = [int(Param.SKEW_XXX), int(Param.SKEW_XXY), int(Param.SKEW_XYY), int(Param.SKEW_YYY)]
SHAPE_PARAMS = [*SKEW_PARAMS, int(Param.KURTOSIS)]  # what makes a point spread no Gaussian
_RARE_ROWS = np.array([Param.STREAK_X, Param.STREAK_Y, *SHAPE_PARAMS, Param.EDGE_TONE])
_SHARE_STEPS = 400
_CURVE_STEPS = 64  # between ink and plate
GEOMETRY_ROWS = 11  # of pose and blur, without the shape of the point spread
# Beyond ink and plate, where curves still follow their formula; light in shade is mostly between.
_CURVED_BELOW, _CURVED_ABOVE = 0.05, 0.1
_MEAN_SQUARE = 0.625  # of the distances of both edges from the centre, in ring radii
# Newton's method along the tone curve goes astray where that is flatter, or by longer steps.
_NEWTON_STEPS, _LEAST_SLOPE, _MOST_MOVED = 4, 0.1, 0.3
_NOTHING = np.zeros((2, 1))  # added to the levels of all pixels
_NO_VALUES = np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class PhotometricModel:
    """Relation of white share to grey value, for the n pixels of one sample."""

    offsets: FloatArray  # (2, n): from the target's centre, in ring radii
    # `LINEAR` and `SRGB` are applied as known, the others use the tone parameters
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
        mask = self._mask_in_light(added)
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
        """Return the changes (k, n) of the levels that follow from changes of the share.

        They are to first order; `rows` (k, n) are the changes of the share, `added` as in `levels`.
        """
        value, values = np.empty(len(share)), light.values
        _expose(share, self.offsets, values, self._added(added), value)
        lit, curved = _light_at(self.offsets, values)
        ink, between = (0.0, 1.0) if added is None else (added[0], 1.0 + added[1] - added[0])
        bent = share + light.edge_tone * share * (1.0 - share)
        by_share = 1.0 + light.edge_tone * (1.0 - 2.0 * share)
        x = lit * (ink + between * bent) + (lit - 1.0) * light.black / (light.white - light.black)
        by_light = _slopes_of_toned(x, values)[-1]
        carried: FloatArray = curved * lit * between * by_light * by_share * rows
        mask = self._mask_in_light(added)
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
        """Return the levels of ink and of plate at all pixels, where the light is uneven."""
        ink, plate = toned(added[0], light.values), toned(1.0 + added[1], light.values)
        return _encoded_pixels(ink, self.tone), _encoded_pixels(plate, self.tone)

    def _mask_in_light(self, added: FloatArray | None) -> Mask | None:
        """Return the mask of what is sharpened before the tone curve; None: nothing is.

        Before a straight line it would be the same as after it, and in uneven light it is not
        estimated (`without_even_light`).
        """
        return self.mask if self.tone is Tone.UNKNOWN and added is None else None

    def _sharpen_levels(
        self, mask: Mask, jacobian: FloatArray, light: Light, added: FloatArray
    ) -> None:
        """Sharpen the derivatives by what is added to ink and to plate.

        Those by the levels and by the tone curve lack what the mask takes from pixels that are not
        modelled, each of which has its own level.
        """
        ink, plate = (self._level_slopes(x, light) for x in (added[0], 1.0 + added[1]))
        for k, row in enumerate(_LEVEL_ROWS if self.tone.is_shaped else _LEVEL_ROWS[:2]):
            jacobian[row] -= light.sharpening * (mask.ink * ink[k] + mask.plate * plate[k])
        by_ink, by_plate = jacobian[PARAM_COUNT], jacobian[PARAM_COUNT + 1]
        by_ink += light.sharpening * mask.detail(by_ink, ink[-1], 0.0)
        by_plate += light.sharpening * mask.detail(by_plate, 0.0, plate[-1])

    def _level_slopes(self, x: FloatArray, light: Light) -> FloatArray:
        """Return the derivatives (6, n) of grey values by `_LEVEL_ROWS`, and by the light x."""
        slopes = _slopes_of_toned(x, light.values)
        if self.tone.is_srgb:
            of_curve = np.empty(len(x))
            encode_pixels(toned(x, light.values), of_curve)
            slopes *= of_curve
        return slopes

    def _added(self, added: FloatArray | None) -> FloatArray:
        return _NOTHING if added is None else added

    def linearised(
        self, share: WhiteShare, light: Light, added: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the grey values (n,) and their Jacobian; `added` as in `levels`.

        It has 21 rows, or 27 where the point spread is skew or has a kurtosis. Where the light is
        uneven it has 29, the last two by what is added to ink and to plate.
        """
        value = np.empty(len(share.value))
        has_shape = len(share.jacobian) > GEOMETRY_ROWS
        rows = PARAM_COUNT if has_shape or added is not None else PLAIN_COUNT
        jacobian = np.empty((rows + (0 if added is None else 2), len(value)))
        _expose_with_slopes(
            share.value,
            share.jacobian,
            self.offsets,
            light.values,
            self._added(added),
            self.tone.is_shaped,
            value,
            jacobian,
        )
        in_light, detail, slope = self._mask_in_light(added), None, None
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
        """Return what the mask adds to the grey values at full strength.

        Where no edge is near there is no blur, and over the mask the light's gradient is flat.
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
        """Sharpen the rows of a Jacobian in the light, carry them to grey values, and sharpen them.

        `detail` is what is sharpened in the light at full strength, None: nothing; `slope` that of
        the curve to grey values, None: there is none.
        """
        rows, in_light = [*_FILTERED], (0.0, _NO_VALUES)
        if self.tone.is_shaped:
            rows += _TONE_ROWS
        if detail is not None:
            rows.append(Param.LINEAR_SHARPENING)
            in_light = light.linear_sharpening, detail
        others = (1.0, 1.0)
        if added is not None:  # `_sharpen_levels` counts them
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


def share_before_edge_tone(bent: FloatArray, light: Light) -> FloatArray:
    """Return the white share (n,), of what the tone of edges makes of it."""
    at_ink = 1.0 + light.edge_tone  # slope of the share that is bent
    root = np.sqrt(np.maximum(at_ink * at_ink - 4.0 * light.edge_tone * bent, 0.0))
    return np.asarray(2.0 * bent / (at_ink + root))


def share_at(level: float, light: Light, tone: Tone) -> float:
    """Return the white share at which a grey value is reached, 0…1, in light that is even."""
    return _share_at(float(decoded(np.array(level), tone)), light.values)


@inlined
def _toned(
    x: float, tone_1: float, tone_2: float, tone_3: float
) -> tuple[float, float, float, float, float]:
    """Return the tone curve at a share x, its slope, and its derivatives by its parameters.

    Beyond ink and plate it soon goes on straight.
    """
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
def _bent(share: float, edge_tone: float) -> tuple[float, float]:
    """Return the white share as processing at edges makes it, and its slope."""
    return share + edge_tone * share * (1.0 - share), 1.0 + edge_tone * (1.0 - 2.0 * share)


@compiled
def _share_at(level: float, light: tuple[float, ...]) -> float:
    """Return where between ink and plate a level is first passed for good, by steps of 1/400."""
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, _ = light
    highest = black
    if level < highest:
        return 0.0
    for k in range(1, _SHARE_STEPS + 1):
        t = k / _SHARE_STEPS
        tone, _, _, _, _ = _toned(t, tone_1, tone_2, tone_3)
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
        tone, _, _, _, _ = _toned(x[i], light[5], light[6], light[7])
        level[i] = light[0] + (light[1] - light[0]) * tone
    return level


def toned_between(share: FloatArray, light: Light) -> FloatArray:
    """Return what `toned` does of shares from 0 to 1, without the time that compiled code takes."""
    arch, lean = share * (1.0 - share), 2.0 * share - 1.0
    tone = share + arch * (light.tone_1 + lean * (light.tone_2 + lean * light.tone_3))
    return np.asarray(light.black + (light.white - light.black) * tone)


def light_over(light: Light, tone: Tone, other: Tone) -> Light:
    """Return the light that has nearly the same grey values over another base of the tone curve.

    Those of ink and plate are the same; between them, the three shapes are fitted by least squares
    of the light.
    """
    share = np.linspace(0.0, 1.0, _CURVE_STEPS + 1)
    level = decoded(encoded(toned_between(share, light), tone), other)
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
def _slopes_of_toned(x: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the derivatives (6, n) of `toned`: by ink, plate, the tone parameters, and by x."""
    slopes, contrast = np.empty((6, len(x))), light[1] - light[0]
    for i in range(len(x)):
        tone, slope, by_1, by_2, by_3 = _toned(x[i], light[5], light[6], light[7])
        slopes[0, i], slopes[1, i] = 1.0 - tone, tone
        slopes[2, i], slopes[3, i], slopes[4, i] = contrast * by_1, contrast * by_2, contrast * by_3
        slopes[5, i] = contrast * slope
    return slopes


@compiled
def light_after_step(
    x: FloatArray, step: FloatArray, before: tuple[float, ...], after: tuple[float, ...]
) -> FloatArray:
    """Return light x (n,) after a step of x and of a `Light`, with the levels that it promises.

    The promise is their change to first order, by the derivatives before the step. Where the curve
    after it is too flat to tell, x just moves by the step.
    """
    moved, contrast = np.empty(len(x)), after[1] - after[0]
    for i in range(len(x)):
        tone, slope, by_1, by_2, by_3 = _toned(x[i], before[5], before[6], before[7])
        shape = tone + slope * step[i] + by_1 * (after[5] - before[5])
        shape += by_2 * (after[6] - before[6]) + by_3 * (after[7] - before[7])
        level = before[0] + (before[1] - before[0]) * shape
        level += (1.0 - tone) * (after[0] - before[0]) + tone * (after[1] - before[1])
        goal, at, is_steep = (level - after[0]) / contrast, x[i] + step[i], True
        for _ in range(_NEWTON_STEPS):
            tone, slope, _, _, _ = _toned(at, after[5], after[6], after[7])
            is_steep &= slope > _LEAST_SLOPE
            at += min(max((goal - tone) / max(slope, _LEAST_SLOPE), -_MOST_MOVED), _MOST_MOVED)
        moved[i] = at if is_steep else x[i] + step[i]
    return moved


@inlined
def _lit(x: float, y: float, light: tuple[float, ...]) -> tuple[float, float, float]:
    """Return the light at a place in ring radii, the factor that curves the level, and its bulge.

    The curvature leaves the mean of both edges as it is: of (1² + ½²)/2 for a ring half as wide
    inside, so that it is not mistaken for the level of white.
    """
    bulge = x * x + y * y - _MEAN_SQUARE
    return 1.0 + light[2] * x + light[3] * y, 1.0 + light[4] * bulge, bulge


@compiled
def _light_at(offsets: FloatArray, light: tuple[float, ...]) -> FloatArray:
    """Return the light, and what curves the level, (2, n) at all places."""
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
    """Fill in black + (white − black) · tone(x), with x as in the module's description."""
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, edge_tone = light
    each = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, each * i], 1.0 + added[1, each * i]
        lit, curved, _ = _lit(offsets[0, i], offsets[1, i], light)
        bent, _ = _bent(share[i], edge_tone)
        x = lit * (ink + (plate - ink) * bent) + (lit - 1.0) * black / (white - black)
        tone, _, _, _, _ = _toned(x, tone_1, tone_2, tone_3)
        value[i] = curved * (black + (white - black) * tone)


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
    """Extend `_expose` by derivatives: by geometry (11 or 16, n), and in the order of `Param`.

    Where the light is uneven, those by what is added to ink and to plate follow.
    """
    black, white, _, _, _, tone_1, tone_2, tone_3, _, _, edge_tone = light
    contrast, gains = white - black, np.empty(len(share))
    has_shape = by_geometry.shape[0] > GEOMETRY_ROWS
    each = 1 if added.shape[1] > 1 else 0
    for i in range(len(share)):
        ink, plate = added[0, each * i], 1.0 + added[1, each * i]
        right, down = offsets[0, i], offsets[1, i]
        lit, curved, bulge = _lit(right, down, light)
        bent, by_share = _bent(share[i], edge_tone)
        x = ink + (plate - ink) * bent
        tone, slope, by_1, by_2, by_3 = _toned(
            lit * x + (lit - 1.0) * black / contrast, tone_1, tone_2, tone_3
        )
        core = black + contrast * tone
        value[i] = curved * core
        gain = curved * contrast * lit
        gains[i] = gain * slope * (plate - ink) * by_share
        of_ink_light = slope * (lit - 1.0) / contrast  # by black / contrast, which is part of x
        jacobian[_BLACK, i] = curved * (1.0 - tone + of_ink_light * white)
        jacobian[_WHITE, i] = curved * (tone - of_ink_light * black)
        by_light = curved * slope * (black + contrast * x)
        jacobian[_SLOPE_X, i], jacobian[_SLOPE_Y, i] = by_light * right, by_light * down
        bend = curved * contrast if has_tone else 0.0
        jacobian[_CURVATURE, i] = core * bulge
        jacobian[_TONE_1, i], jacobian[_TONE_2, i] = bend * by_1, bend * by_2
        jacobian[_TONE_3, i] = bend * by_3
        jacobian[_SHARPENING, i] = jacobian[_LINEAR_SHARPENING, i] = 0.0
        if len(jacobian) > _EDGE_TONE:
            jacobian[_EDGE_TONE, i] = 0.0
        if each:
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
