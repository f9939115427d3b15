"""The adjustment of one disc: ellipse, blur and light from the grey values around its edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg.lapack import dposv

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.adjustment.normal_equations import scaled_rows, weighted_products
from kgcp.measurement.discs.affine_model import DiscPixels, Geometry, limited
from kgcp.measurement.discs.pixel_choice import DiscWindow
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.noise import (
    Censoring,
    GreyNoise,
    Misfit,
    estimate_noise,
    misfit,
)
from kgcp.measurement.image_model.photometry import (
    PARAM_COUNT,
    PLAIN_COUNT,
    Light,
    Param,
    PhotometricModel,
    Tone,
)
from kgcp.measurement.image_model.sharpening import unsharp_mask

GEOMETRY_COUNT = 5  # x, y and the stretch xx, xy, yy: rows 0…4, as a plate's pose takes 0…5
INK_SLOPE_X, INK_SLOPE_Y = PLAIN_COUNT, PLAIN_COUNT + 1  # of the darker level alone, per radius
COUNT = PLAIN_COUNT + 2
_SHARPENING_PX = 1.2  # σ of the cameras' unsharp mask, as for coded targets
_MIN_VARIANCE_PX2 = 0.075  # a pixel alone spreads by 1/12 px²
_MAX_ANISOTROPY = 0.95
_MOST_FLAT = 0.6  # by how much a tone curve may be less steep at its ends than in the mean
_STEPS = 12
_ENOUGH = 0.02  # of log-likelihood, promised by a step
_NOISE_ROUNDS, _SETTLED_NOISE = 3, 0.05
_DAMPING, _DAMPED, _MOST_DAMPING = 1e-6, 1e-3, 1e6

# Independent normal priors of what a disc alone hardly tells; lengths in radii.
_PRIOR_SD = {
    int(Param.BLUR_DIFFERENCE): 0.3,  # px²
    int(Param.BLUR_XY): 0.3,
    int(Param.SLOPE_X): 0.1,
    int(Param.SLOPE_Y): 0.1,
    # narrower than for coded targets: a disc has one edge, and a point spread with wide tails looks
    # like a curve that is flat at its end
    int(Param.TONE_1): 0.25,
    int(Param.TONE_2): 0.1,
    int(Param.TONE_3): 0.1,
    int(Param.SHARPENING): 0.7,
    INK_SLOPE_X: 0.05,
    INK_SLOPE_Y: 0.05,
}
_WHITE, _WHITE_SD = 1.0, 0.4  # burnt levels of unknown tone: lest level and tone drift together
_ALWAYS = (*range(GEOMETRY_COUNT), Param.BLUR_MEAN, Param.BLUR_DIFFERENCE, Param.BLUR_XY)
_LIGHT = (Param.BLACK, Param.WHITE, Param.SLOPE_X, Param.SLOPE_Y)
_TONES = (Param.TONE_1, Param.TONE_2, Param.TONE_3)
_INK_SLOPES = (INK_SLOPE_X, INK_SLOPE_Y)
CAMERA_ROWS = tuple(int(row) for row in (*_TONES, Param.SHARPENING))
"""What all discs of a photograph share: the camera's tone curve and sharpening."""


class NoFit(Exception):  # noqa: N818 - the outcome of one disc
    """The equations of a disc cannot be solved."""


@dataclass(frozen=True, slots=True)
class FreeParameters:
    """What is estimated of a disc beside geometry, blur, levels and light's gradient."""

    tone: Tone
    sharpens: bool = False
    has_ink_slope: bool = False  # a gradient of its own for the darker level: large discs
    # mean and standard deviation of tone and sharpening, as other discs of the photograph show
    # them, in the order of `CAMERA_ROWS`; empty: not known
    camera: tuple[tuple[float, float], ...] = ()
    blur_px: float = 0.0  # to start from; 0: not known

    @property
    def rows(self) -> IndexArray:
        """The free parameters (p,)."""
        return _rows(self)

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and precision (21,) of the priors; precision 0: none."""
        return _prior(self)


@cache
def _rows(free: FreeParameters) -> IndexArray:
    rows = [*_ALWAYS, *_LIGHT]
    rows += _TONES if free.tone.is_shaped else ()
    rows += (Param.SHARPENING,) if free.sharpens else ()
    rows += _INK_SLOPES if free.has_ink_slope else ()
    return np.array([int(row) for row in sorted(rows)])


@cache
def _prior(free: FreeParameters) -> tuple[FloatArray, FloatArray]:
    mean, precision = np.zeros(COUNT), np.zeros(COUNT)
    for row, sd in _PRIOR_SD.items():
        precision[row] = sd**-2 if row in free.rows else 0.0
    if free.tone.is_shaped:
        mean[Param.WHITE], precision[Param.WHITE] = _WHITE, _WHITE_SD**-2
    for row, (value, sd) in zip(CAMERA_ROWS, free.camera, strict=False):
        if row in free.rows:
            mean[row], precision[row] = value, sd**-2
    return mean, precision


@dataclass(frozen=True, slots=True, eq=False)
class DiscState:
    """Numbers that the adjustment works with."""

    vector: FloatArray  # (21,): geometry, 0, and the others in the order of `Param`; ink slopes

    @classmethod
    def of(cls, geometry: Geometry, blur: Blur, light: Light) -> DiscState:
        """Collect the numbers."""
        mean, difference = 0.5 * (blur.xx + blur.yy), 0.5 * (blur.xx - blur.yy)
        values = (*geometry, 0.0, mean, difference, blur.xy, 0.0, 0.0, *light.values, 0.0, 0.0)
        return cls(np.array(values))

    @property
    def geometry(self) -> Geometry:
        """Centre and stretch (5,)."""
        return self.vector[:GEOMETRY_COUNT]

    @property
    def blur(self) -> Blur:
        """The blur."""
        mean, difference, xy = self.vector[Param.BLUR_MEAN : Param.STREAK_X].tolist()
        return Blur(mean + difference, mean - difference, xy)

    @property
    def light(self) -> Light:
        """The light."""
        return Light(*self.vector[Param.BLACK : PLAIN_COUNT].tolist())

    def moved(self, step: FloatArray) -> DiscState:
        """Return the state after a step (21,), such that ellipse and blur can be."""
        moved, before = self.vector + step, self.vector[Param.BLUR_MEAN]
        moved[:GEOMETRY_COUNT] = limited(moved[:GEOMETRY_COUNT])
        if step[Param.BLUR_MEAN] < 0.0:  # what steps promise of narrower blur is too much
            moved[Param.BLUR_MEAN] = before**2 / (before - step[Param.BLUR_MEAN])
        moved[Param.BLUR_MEAN] = max(moved[Param.BLUR_MEAN], _MIN_VARIANCE_PX2)
        moved[_TONES[0] : _TONES[-1] + 1] *= _steep_enough(*moved[_TONES[0] : _TONES[-1] + 1])
        elongation = math.hypot(moved[Param.BLUR_DIFFERENCE], moved[Param.BLUR_XY])
        excess = elongation / (_MAX_ANISOTROPY * moved[Param.BLUR_MEAN])
        if excess > 1.0:
            moved[Param.BLUR_DIFFERENCE] /= excess
            moved[Param.BLUR_XY] /= excess
        return DiscState(moved)


def _steep_enough(tone_1: float, tone_2: float, tone_3: float) -> float:
    """Return a factor 0…1 that keeps a tone curve from being flat at its ends.

    Where it is flat, the ground shows no gradient of the light however large it is, and the
    gradient explains whatever makes opposite edges differ: coma, or the order of the rows.
    """
    flattest = max(tone_1 + tone_2 + tone_3, tone_2 - tone_1 - tone_3)
    return min(1.0, _MOST_FLAT / flattest) if flattest > 0.0 else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class DiscSample:
    """The pixels of one round."""

    pixels: DiscPixels
    levels: FloatArray  # (n,)
    censoring: Censoring
    photometry: PhotometricModel
    levels_per_count: float
    offsets: FloatArray  # (2, n): from the disc's middle, in radii
    radius_px: float  # that `offsets` are in

    @classmethod
    def of(
        cls,
        window: DiscWindow,
        index: IndexArray,
        state: DiscState,
        limits: Censoring,
        free: FreeParameters,
        *,
        is_dark: bool,
        radius_px: float,
    ) -> DiscSample:
        """Take pixels of a window, by their flat indices."""
        places = window.places_px(index)
        pixels = DiscPixels.of(places, state.geometry, state.blur, is_dark=is_dark)
        offsets = (places - state.geometry[:2, None]) / radius_px
        mask = None
        if free.sharpens:
            everywhere = window.places_px(np.arange(len(window.levels)))
            whole = DiscPixels.of(everywhere, state.geometry, state.blur, is_dark=is_dark)
            share = whole.white_share(state.geometry, state.blur).value
            shape = (window.height, window.width)
            mask = unsharp_mask(shape, index, share, _SHARPENING_PX)
        censoring = replace(limits, at_high=limits.at_high[index], at_low=limits.at_low[index])
        return cls(
            pixels,
            window.levels[index],
            censoring,
            PhotometricModel(offsets, free.tone, mask),
            window.levels_per_count,
            offsets,
            radius_px,
        )


@dataclass(frozen=True, slots=True, eq=False)
class DiscFit:
    """The state of an adjustment."""

    sample: DiscSample
    free: FreeParameters
    state: DiscState
    share: FloatArray  # (n,): white share
    levels: FloatArray  # (n,): modelled, before clipping
    jacobian: FloatArray  # (21, n)
    sd: FloatArray  # (n,): noise of every pixel, as level
    misfit: Misfit
    scaled: FloatArray  # (p, n): Jacobian of the free parameters, in units of the noise
    normal: FloatArray  # (p, p): with the priors

    @property
    def noise(self) -> GreyNoise:
        """The noise that the residuals show."""
        return _noise(self.sample, self.share, self.levels)

    @property
    def loss_per_pixel(self) -> float:
        """Negative log-likelihood with the noise's own part, over the pixels; to compare tones."""
        return (self.misfit.total + float(np.log(self.sd).sum())) / len(self.sd)


def fit_disc(sample: DiscSample, start: DiscState, free: FreeParameters) -> DiscFit:
    """Minimise the negative log-likelihood, until the noise is the one that residuals show.

    Raises
    ------
    NoFit
        If the equations cannot be solved.
    """
    state = start
    share, levels, _ = _linearised(sample, state, free)
    sd = _noise(sample, share, levels).sd
    for _ in range(_NOISE_ROUNDS):
        fit = _minimise(sample, state, free, sd)
        state = fit.state
        before, sd = sd, fit.noise.sd
        if abs(float(sd.sum() / before.sum()) - 1.0) < _SETTLED_NOISE:
            break
    return fit


def _linearised(
    sample: DiscSample, state: DiscState, free: FreeParameters
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return white share, grey values (n,) and Jacobian (21, n).

    A known curve is applied to light that falls off; so must be an unknown one. It is given the
    gradient as what the light has more on ink and on plate, and not as a factor after the curve.
    """
    share, light = sample.pixels.white_share(state.geometry, state.blur), state.light
    jacobian, offsets = np.zeros((COUNT, len(share.value))), sample.offsets
    if not (free.tone.is_shaped or free.has_ink_slope):
        levels, jacobian[:PLAIN_COUNT] = sample.photometry.linearised(share, light)
        return share.value, levels, jacobian
    added = np.zeros_like(offsets)
    added[0] = state.vector[INK_SLOPE_X:] @ offsets
    of_ink = of_plate = 0.0
    if free.tone.is_shaped:
        contrast = max(light.white - light.black, sample.levels_per_count)
        of_ink, of_plate = light.black / contrast, light.white / contrast
        falling = state.vector[Param.SLOPE_X : Param.TONE_1] @ offsets
        added[0] += of_ink * falling
        added[1] += of_plate * falling
        light = replace(light, slope_x=0.0, slope_y=0.0)
    levels, slopes = sample.photometry.linearised(share, light, added)
    jacobian[:PLAIN_COUNT] = slopes[:PLAIN_COUNT]
    by_ink, by_plate = slopes[PARAM_COUNT], slopes[PARAM_COUNT + 1]
    jacobian[INK_SLOPE_X:] = by_ink * offsets
    if free.tone.is_shaped:
        by_both = of_ink * by_ink + of_plate * by_plate
        jacobian[Param.SLOPE_X : Param.TONE_1] = by_both * offsets
    return share.value, levels, jacobian


def _noise(sample: DiscSample, share: FloatArray, levels: FloatArray) -> GreyNoise:
    """Return the noise of every pixel; clipped ones would make their own."""
    limits = sample.censoring
    usable = ~(limits.at_high | limits.at_low) & (levels > limits.low) & (levels < limits.high)
    return estimate_noise(sample.levels - levels, share, usable, sample.levels_per_count)


def _minimise(
    sample: DiscSample, state: DiscState, free: FreeParameters, sd: FloatArray
) -> DiscFit:
    """Take damped Gauss-Newton steps (Levenberg-Marquardt)."""
    fit, damping = _fit_at(sample, state, free, sd), _DAMPING
    total = fit.misfit.total + _penalty(fit.state, free)
    for _ in range(_STEPS):
        step, promised = _step(fit, damping)
        if promised < _ENOUGH:
            break
        trial = _fit_at(sample, fit.state.moved(step), free, sd)
        trial_total = trial.misfit.total + _penalty(trial.state, free)
        if trial_total <= total:
            fit, total, damping = trial, trial_total, max(0.1 * damping, _DAMPING)
            continue
        damping = max(10.0 * damping, _DAMPED)
        if damping > _MOST_DAMPING:
            break
    return fit


def _fit_at(sample: DiscSample, state: DiscState, free: FreeParameters, sd: FloatArray) -> DiscFit:
    share, levels, jacobian = _linearised(sample, state, free)
    current = misfit(sample.levels, levels, sd, sample.censoring)
    scaled = scaled_rows(jacobian, free.rows, sd)
    normal = weighted_products(scaled, current.weight, free.prior[1][free.rows])
    return DiscFit(sample, free, state, share, levels, jacobian, sd, current, scaled, normal)


def _penalty(state: DiscState, free: FreeParameters) -> float:
    mean, precision = free.prior
    return 0.5 * float(precision @ (state.vector - mean) ** 2)


def _step(fit: DiscFit, damping: float) -> tuple[FloatArray, float]:
    """Return a step (21,) and the gain that it promises."""
    rows, (mean, precision) = fit.free.rows, fit.free.prior
    gradient = fit.scaled @ fit.misfit.score
    gradient += (precision * (mean - fit.state.vector))[rows]
    damped = fit.normal.copy()
    damped[np.diag_indices_from(damped)] *= 1.0 + damping
    _, solution, failure = dposv(damped, gradient)
    promised = 0.5 * float(gradient @ solution)
    if failure or not math.isfinite(promised):
        raise NoFit
    step = np.zeros(COUNT)
    step[rows] = solution
    return step, promised
