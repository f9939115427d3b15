"""The adjustment of one disc: ellipse, blur and light from the grey values around its edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.adjustment.normal_equations import scaled_rows, weighted_products
from kgcp.measurement.discs.affine_model import NO_INNER, DiscPixels, Geometry, limited
from kgcp.measurement.discs.disc_levels import COUNT, CURVES, GEOMETRY_COUNT, LevelModel, Row
from kgcp.measurement.discs.pixel_choice import DiscWindow
from kgcp.measurement.discs.tone_curve import DiscTone, plausible
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.noise import (
    Censoring,
    GreyNoise,
    Misfit,
    estimate_noise,
    misfit,
)
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.sharpening import Mask, unsharp_mask
from kgcp.measurement.image_model.srgb import srgb_decoded, srgb_slope

SHARPENING_PX = 1.0  # σ of a camera's unsharp mask, until it is learned
_MIN_VARIANCE_PX2 = 0.075  # a pixel alone spreads by 1/12 px²
_MAX_ANISOTROPY = 0.95
_STEPS = 12
_LEAST_PROMISE = 0.02  # a step that promises a smaller gain in log-likelihood is not taken
_SMALL_SHARE = 1e-4  # of a step, for a numerical derivative along it
_NOISE_ROUNDS, _SETTLED_NOISE = 8, 0.02
_LEAST_RESIDUAL_SHARE = 0.25  # of a pixel's variance that its residual is taken to have, at least
_LEAST_FREEDOM = 8.0  # of an edge's noise; with less, deviations at R 3 px were 10 % too large
_CLIP_SIGMAS = 2.5  # pixels modelled nearer to a clipping limit are not used for the noise
_FEWEST_OF_NOISE = 8  # pixels
# Largest margin to the clipping limits, as a share of the range between them. If it is reached,
# residuals are not noise but show what the model lacks. A wider margin would leave only pixels at
# edges, and these would make the noise, and the margin, larger still.
_MOST_MARGIN = 0.1
_DAMPING, _DAMPED, _MOST_DAMPING = 1e-6, 1e-3, 1e6

# Independent normal priors of parameters that one disc hardly tells; lengths in radii.
_PRIOR_SD = {
    Row.BLUR_DIFFERENCE: 0.3,  # px²
    Row.BLUR_XY: 0.3,
    Row.SLOPE_X: 0.1,  # at most: see `DiscUnknowns.in_light`
    Row.SLOPE_Y: 0.1,
    Row.WAVE_1: 0.3,
    Row.WAVE_2: 0.4,
    Row.WAVE_3: 0.2,
    Row.SHARPENING: 0.7,
    Row.INK_SLOPE_X: 0.05,
    Row.INK_SLOPE_Y: 0.05,
}
# Priors of the light's first and second order where the edge of a shadow crosses the disc
_SHADOW_SLOPE_SD = 0.3
_SHADOW_CURVE_SD = 0.2
# Least and largest strength of a camera's unsharp mask; negative ones stand for the skirts of a
# point spread. Burnt discs show little of their edges, and would go to 3 and take their blur along.
_SHARPENINGS = (-0.5, 1.5)
_FALL = 0.7  # standard deviation of the change of light from a photograph's middle to its end
# Prior of burnt white with an unknown tone; without it, the two would drift together
_WHITE, _WHITE_SD = 1.0, 0.4
_ALWAYS = (*range(GEOMETRY_COUNT), Row.BLUR_MEAN, Row.BLUR_DIFFERENCE, Row.BLUR_XY)
_LIGHT = (Row.BLACK, Row.WHITE, Row.SLOPE_X, Row.SLOPE_Y)
_SLOPES = np.array((Row.SLOPE_X, Row.SLOPE_Y))
_WAVES = (Row.WAVE_1, Row.WAVE_2, Row.WAVE_3)
_INK_SLOPES = (Row.INK_SLOPE_X, Row.INK_SLOPE_Y)
# additional unknowns at the edge of a shadow
_UNEVEN = np.array((*_INK_SLOPES, *CURVES.tolist()))
_UNEVEN_PRECISIONS = np.array([_SHADOW_SLOPE_SD] * 2 + [_SHADOW_CURVE_SD] * 3) ** -2.0
CAMERA_ROWS = (*_WAVES, Row.SHARPENING)
"""The parameters that all discs share: the camera's tone curve and sharpening."""


class NoFit(Exception):  # noqa: N818 - the outcome of one disc
    """The equations of a disc cannot be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class ProcessingPrior:
    """What is known of the camera beforehand, in the order of `CAMERA_ROWS`."""

    mean: FloatArray  # (4,)
    precision: FloatArray  # (4, 4)

    @classmethod
    def usual(cls) -> ProcessingPrior:
        """Return what is known of any camera."""
        sd = np.array([_PRIOR_SD[row] for row in CAMERA_ROWS])
        return cls(np.zeros(len(sd)), np.diag(sd**-2))


@dataclass(frozen=True, slots=True, eq=False)
class DiscUnknowns:
    """What is estimated of a disc, and what is known beforehand."""

    tone: Tone
    sharpening_px: float  # σ of the camera's unsharp mask; 0: it does not sharpen
    rows: IndexArray  # (p,): the free parameters
    mean: FloatArray  # (21,)
    precision: FloatArray  # (21, 21); zeros: nothing is known
    is_tone_stated: bool  # whether the tone is the camera's, or one to start from
    kurtosis: float = 0.0  # known excess kurtosis of the point spread
    is_curve_unknown: bool = False  # whether the tone curve is learned from discs
    is_compressed: bool = False  # whether the photograph is a JPEG, or was one
    curve_spread_px: float = 0.0  # by how much curves displace edges that a few discs leave open
    kurtosis_sd: float = 0.0  # standard deviation of the kurtosis

    @classmethod
    def of(
        cls,
        tone: Tone,
        prior: ProcessingPrior | None = None,
        *,
        sharpening_px: float = 0.0,
        has_ink_slope: bool = False,
        is_tone_stated: bool = True,
        kurtosis: float = 0.0,
        is_curve_unknown: bool = False,
        is_compressed: bool = False,
        curve_spread_px: float = 0.0,
    ) -> DiscUnknowns:
        """Return the unknowns of a disc.

        Parameters
        ----------
        prior : ProcessingPrior
            What is learned of tone and sharpening; None: what is known of any camera.
        has_ink_slope : bool
            Whether the darker level has a gradient of its own: large discs.
        sharpening_px, is_tone_stated, kurtosis, is_curve_unknown, is_compressed, curve_spread_px
            As the attributes.
        """
        rows = [*_ALWAYS, *_LIGHT]
        rows += _WAVES if tone.is_shaped else ()
        rows += (Row.SHARPENING,) if sharpening_px else ()
        rows += _INK_SLOPES if has_ink_slope else ()
        free = np.array(sorted(map(int, rows)))
        known = prior or ProcessingPrior.usual()
        mean, precision = np.zeros(COUNT), np.zeros((COUNT, COUNT))
        for row, sd in _PRIOR_SD.items():
            precision[row, row] = sd**-2
        shared = np.array(CAMERA_ROWS)
        mean[shared], precision[np.ix_(shared, shared)] = known.mean, known.precision
        if tone.is_shaped:
            mean[Row.WHITE], precision[Row.WHITE, Row.WHITE] = _WHITE, _WHITE_SD**-2
        is_fixed = ~np.isin(np.arange(COUNT), free)
        precision[is_fixed], precision[:, is_fixed] = 0.0, 0.0
        return cls(
            tone,
            sharpening_px,
            free,
            mean,
            precision,
            is_tone_stated,
            kurtosis=kurtosis,
            is_curve_unknown=is_curve_unknown,
            is_compressed=is_compressed,
            curve_spread_px=curve_spread_px,
        )

    def without_ink_slope(self) -> DiscUnknowns:
        """Return the unknowns without a gradient of the darker level's own."""
        return replace(self, rows=np.setdiff1d(self.rows, np.array(_INK_SLOPES)))

    @property
    def is_light_curved(self) -> bool:
        """Whether the light is of second order."""
        return bool(self.rows[-1] == Row.CURVE_YY)

    def with_curved_light(self) -> DiscUnknowns:
        """Return the unknowns of a disc at the edge of a shadow: light of second order.

        The darker level gets a gradient of its own, too, whatever the disc's size: a step of the
        light through the middle of a disc has odd orders only, and these displace the centre.
        """
        precision = self.precision.copy()
        precision[_UNEVEN, _UNEVEN] = _UNEVEN_PRECISIONS
        return replace(self, rows=np.union1d(self.rows, _UNEVEN), precision=precision)

    def in_light(self, radius_px: float, frame_px: int, *, is_burnt: bool) -> DiscUnknowns:
        """Return the unknowns with priors for the size of a disc, and for burnt ground.

        The light falls off over a photograph, and so by little over a small disc. On burnt ground,
        only this prior keeps the gradient from explaining whatever makes opposite edges differ.

        The prior of white holds for burnt discs only. Otherwise white is seen, and the prior, added
        by each of many discs, would bend the curve that they share.
        """
        sd = min(_FALL * radius_px / (0.5 * frame_px), _PRIOR_SD[Row.SLOPE_X])
        if self.is_light_curved:
            sd = _SHADOW_SLOPE_SD
        precision = self.precision.copy()
        precision[_SLOPES, _SLOPES] = sd**-2
        if not is_burnt:
            precision[Row.WHITE, Row.WHITE] = 0.0
        return replace(self, precision=precision)

    def penalty(self, vector: FloatArray) -> float:
        """Return the priors' part of the negative log-likelihood of a vector (21,)."""
        off = vector - self.mean
        return 0.5 * float(off @ self.precision @ off)


@dataclass(frozen=True, slots=True, eq=False)
class DiscState:
    """The parameters of a disc."""

    vector: FloatArray  # (21,): in the order of `Row`

    @classmethod
    def of(cls, geometry: Geometry, blur: Blur, levels: tuple[float, float]) -> DiscState:
        """Collect the parameters; levels are the light of ink and plate."""
        vector = np.zeros(COUNT)
        vector[:GEOMETRY_COUNT] = geometry
        mean, difference = 0.5 * (blur.xx + blur.yy), 0.5 * (blur.xx - blur.yy)
        vector[Row.BLUR_MEAN : Row.BLACK] = mean, difference, blur.xy
        vector[[Row.BLACK, Row.WHITE]] = levels
        return cls(vector)

    @property
    def geometry(self) -> Geometry:
        """Centre and stretch (5,)."""
        return self.vector[:GEOMETRY_COUNT]

    @property
    def blur(self) -> Blur:
        """The blur."""
        mean, difference, xy = self.vector[Row.BLUR_MEAN : Row.BLACK].tolist()
        return Blur(mean + difference, mean - difference, xy)

    @property
    def slope(self) -> FloatArray:
        """Gradient of the light (2,) per radius."""
        return self.vector[Row.SLOPE_X : Row.WAVE_1]

    def tone(self, tone: Tone) -> DiscTone:
        """Return the tone curve."""
        return DiscTone(tone).bent(self.vector[Row.WAVE_1 : Row.SHARPENING])

    def plateaus(self, tone: Tone) -> tuple[float, float]:
        """Return the grey values of ink and plate before clipping."""
        black, white = self.tone(tone).levels(self.vector[[Row.BLACK, Row.WHITE]]).tolist()
        return black, white

    def share_at(self, level: float, tone: Tone) -> float:
        """Return the white share that has a grey value in even light, 0…1."""
        black, white = self.vector[[Row.BLACK, Row.WHITE]].tolist()
        light = float(self.tone(tone).light(np.array([level]))[0])
        share = (light - black) / max(white - black, 1e-9)
        return float(min(max(share, 0.0), 1.0))

    def moved(self, step: FloatArray, tone: Tone) -> DiscState:
        """Return the state after a step (21,), with ellipse, blur and tone kept possible.

        If the tone curve changes, the levels follow it, so that their grey values change by what
        the step promises to first order. Independent steps of curve and levels would go wrong.
        """
        moved, before = self.vector + step, self.vector[Row.BLUR_MEAN]
        moved[:GEOMETRY_COUNT] = limited(moved[:GEOMETRY_COUNT])
        if step[Row.BLUR_MEAN] < 0.0:  # steps towards a narrower blur go too far
            moved[Row.BLUR_MEAN] = before**2 / (before - step[Row.BLUR_MEAN])
        moved[Row.BLUR_MEAN] = max(moved[Row.BLUR_MEAN], _MIN_VARIANCE_PX2)
        moved[Row.WAVE_1 : Row.SHARPENING] = plausible(moved[Row.WAVE_1 : Row.SHARPENING], tone)
        low, high = _SHARPENINGS
        moved[Row.SHARPENING] = min(max(moved[Row.SHARPENING], low), high)
        if tone.is_shaped:
            levels = [Row.BLACK, Row.WHITE]
            grey = self.tone(tone).levels(self.vector[levels])
            nearby = self.vector + _SMALL_SHARE * step
            grey += (DiscState(nearby).tone(tone).levels(nearby[levels]) - grey) / _SMALL_SHARE
            moved[levels] = DiscState(moved).tone(tone).light(grey)
        elongation = math.hypot(moved[Row.BLUR_DIFFERENCE], moved[Row.BLUR_XY])
        excess = elongation / (_MAX_ANISOTROPY * moved[Row.BLUR_MEAN])
        if excess > 1.0:
            moved[Row.BLUR_DIFFERENCE] /= excess
            moved[Row.BLUR_XY] /= excess
        return DiscState(moved)


@dataclass(frozen=True, slots=True, eq=False)
class DiscSample:
    """The pixels that are used in one round."""

    pixels: DiscPixels
    levels: FloatArray  # (n,)
    censoring: Censoring
    level_model: LevelModel
    window: DiscWindow  # that they are taken from
    index: IndexArray  # (n,): flat indices in the window
    radius_px: float  # unit of length of the light's gradients
    is_noise_of_light: bool  # whether the noise is linear in the light, not in the grey value

    @classmethod
    def of(
        cls,
        window: DiscWindow,
        index: IndexArray,
        state: DiscState,
        limits: Censoring,
        free: DiscUnknowns,
        *,
        is_dark: bool,
        radius_px: float,
        inner: FloatArray = NO_INNER,
    ) -> DiscSample:
        """Take pixels of a window, by their flat indices."""
        places = window.places_px(index)
        pixels = DiscPixels.of(
            places,
            state.geometry,
            state.blur,
            is_dark=is_dark,
            inner=inner,
            kurtosis=free.kurtosis,
        )
        offsets = (places - state.geometry[:2, None]) / radius_px
        mask = None
        if free.sharpening_px:
            mask = _mask(window, index, state, free.sharpening_px, pixels)
        censoring = replace(limits, at_high=limits.at_high[index], at_low=limits.at_low[index])
        return cls(
            pixels,
            window.levels[index],
            censoring,
            LevelModel(offsets, free.tone, mask),
            window,
            index,
            radius_px,
            free.is_tone_stated and free.tone is Tone.SRGB,
        )

    @property
    def is_burnt(self) -> bool:
        """Whether a level is clipped, and so hardly seen."""
        return self.censoring.hides_a_level(self.levels)

    def unknowns(self, free: DiscUnknowns) -> DiscUnknowns:
        """Return the unknowns of any disc with the priors of this one."""
        return free.in_light(self.radius_px, self.window.frame_px, is_burnt=self.is_burnt)

    def by(self, tone: Tone, sharpening_px: float, state: DiscState) -> DiscSample:
        """Return the same pixels for another tone curve and another unsharp mask."""
        mask = None
        if sharpening_px:
            mask = _mask(self.window, self.index, state, sharpening_px, self.pixels)
        return replace(self, level_model=replace(self.level_model, tone=tone, mask=mask))


def _mask(
    window: DiscWindow,
    index: IndexArray,
    state: DiscState,
    sharpening_px: float,
    pixels: DiscPixels,
) -> Mask:
    """Return the unsharp mask for the pixels of a disc."""
    whole = DiscPixels.of(
        window.places_px(np.arange(len(window.levels))),
        state.geometry,
        state.blur,
        is_dark=pixels.is_dark,
        inner=pixels.inner,
        kurtosis=pixels.kurtosis,
    )
    share = whole.white_share(state.geometry, state.blur).value
    return unsharp_mask((window.height, window.width), index, share, sharpening_px)


@dataclass(frozen=True, slots=True, eq=False)
class DiscFit:
    """The state of an adjustment."""

    sample: DiscSample
    free: DiscUnknowns
    state: DiscState
    share: FloatArray  # (n,): white share
    levels: FloatArray  # (n,): modelled, before clipping
    jacobian: FloatArray  # (21, n)
    sd: FloatArray  # (n,): noise of every pixel, as level
    misfit: Misfit
    scaled: FloatArray  # (p, n): Jacobian of the free parameters, in units of the noise
    normal: FloatArray  # (p, p): with the priors

    @property
    def gradient(self) -> FloatArray:
        """Derivatives (p,) of the log-likelihood with the priors."""
        free = self.free
        of_prior = (free.precision @ (free.mean - self.state.vector))[free.rows]
        return np.asarray(self.scaled @ self.misfit.score + of_prior)

    @property
    def curvature_gain(self) -> float:
        """χ² that curved light would explain, with three to five degrees of freedom."""
        is_new = ~np.isin(_UNEVEN, self.free.rows)
        terms = scaled_rows(self.jacobian, _UNEVEN[is_new], self.sd)
        weighted = terms * self.misfit.weight
        shared = weighted @ self.scaled.T
        information = weighted @ terms.T - shared @ np.linalg.solve(self.normal, shared.T)
        information += np.diag(_UNEVEN_PRECISIONS[is_new])
        score = terms @ self.misfit.score
        return float(score @ np.linalg.solve(information, score))

    @property
    def light_curvature(self) -> FloatArray:
        """Relative second derivatives (2, 2) of the light [1/px²]; zeros: it is linear."""
        xx, xy, yy = (self.state.vector[CURVES] / self.sample.radius_px**2).tolist()
        return np.array(((2.0 * xx, xy), (xy, 2.0 * yy)))

    @property
    def leverage(self) -> FloatArray:
        """Diagonal (n,) of the hat matrix: share of its own error that the fit takes from a pixel.

        Raises
        ------
        NoFit
            If the equations are singular.
        """
        try:
            inverse = np.linalg.inv(self.normal)
        except np.linalg.LinAlgError:
            raise NoFit from None
        with np.errstate(over="ignore", invalid="ignore"):  # of equations that are nearly singular
            own = np.sum((inverse @ self.scaled) * self.scaled, axis=0)
        if not np.isfinite(own).all():
            raise NoFit
        return np.asarray(self.misfit.weight * own)

    @property
    def redundancy(self) -> float:
        """Degrees of freedom: pixels that are not clipped, less those that the unknowns take up."""
        return float(np.sum(1.0 - self.leverage[~self.sample.censoring.is_clipped]))

    @property
    def noise_freedom(self) -> float:
        """Degrees of freedom of the estimated noise of the edge's pixels.

        Noise is estimated from both plateaus. If one of them is clipped, it is estimated from the
        edge itself, provided that this has enough pixels.
        """
        seen = ~self.sample.censoring.is_clipped
        is_edge = seen & (self.share > 0.2) & (self.share < 0.8)
        if not self.sample.is_burnt or np.count_nonzero(is_edge) < _FEWEST_OF_NOISE:
            return self.redundancy
        return max(float(np.sum(1.0 - self.leverage[is_edge])), _LEAST_FREEDOM)

    @property
    def noise(self) -> GreyNoise:
        """The noise that the residuals show, corrected for what the fit has taken from them.

        The residual of a pixel with leverage h has 1 − h of the variance of its noise.
        """
        residual_share = np.maximum(1.0 - self.leverage, _LEAST_RESIDUAL_SHARE)
        return _noise(self.sample, self.share, self.levels, residual_share)


def fit_disc(sample: DiscSample, start: DiscState, free: DiscUnknowns) -> DiscFit:
    """Minimise and estimate the noise from the residuals in turn, until the noise is settled.

    Raises
    ------
    NoFit
        If there are fewer pixels than unknowns, or the equations cannot be solved.
    """
    state, free = start, sample.unknowns(free)
    if len(sample.levels) < len(free.rows):  # other edges reach all other pixels
        raise NoFit
    linear = linearised_at(sample, state)
    sd = _noise(sample, linear.share, linear.levels).sd
    seen = ~sample.censoring.is_clipped
    for _ in range(_NOISE_ROUNDS):
        fit = _minimise(sample, state, free, sd, linear)
        state, linear = fit.state, Linear(fit.share, fit.levels, fit.jacobian)
        before, sd = sd, fit.noise.sd
        changes = np.abs(np.log(sd[seen] / before[seen]))
        if changes.sum() <= _SETTLED_NOISE * len(changes):
            break
    return fit


class Linear(NamedTuple):
    """The image model about a state."""

    share: FloatArray  # (n,): white share
    levels: FloatArray  # (n,)
    jacobian: FloatArray  # (21, n)


def disc_fit_at(
    sample: DiscSample,
    state: DiscState,
    free: DiscUnknowns,
    sd: FloatArray,
    linear: Linear | None = None,
) -> DiscFit:
    """Return a fit linearised at a state, with given noise (n,); `linear`: if that is known."""
    share, levels, jacobian = linear or linearised_at(sample, state)
    current = misfit(sample.levels, levels, sd, sample.censoring)
    scaled = scaled_rows(jacobian, free.rows, sd)
    normal = weighted_products(scaled, current.weight, np.zeros(len(free.rows)))
    normal += free.precision[np.ix_(free.rows, free.rows)]
    return DiscFit(sample, free, state, share, levels, jacobian, sd, current, scaled, normal)


def noise_at(sample: DiscSample, state: DiscState) -> GreyNoise:
    """Return the noise that the residuals of a state show, which need not be fitted."""
    linear = linearised_at(sample, state)
    return _noise(sample, linear.share, linear.levels)


def linearised_at(sample: DiscSample, state: DiscState) -> Linear:
    """Return the image model about a state."""
    share = sample.pixels.white_share(state.geometry, state.blur)
    return Linear(share.value, *sample.level_model.linearised(share, state.vector))


def _noise(
    sample: DiscSample,
    share: FloatArray,
    levels: FloatArray,
    residual_share: FloatArray | float = 1.0,
) -> GreyNoise:
    """Return the noise of every pixel, from those that are not clipped.

    Just below a clipping limit, only pixels with negative noise are not clipped. When they were
    used, the noise at the edges of burnt discs of R 3 px came out 28 % too small. So pixels are
    chosen by their modelled level, a margin away from the limits, which needs a first estimate of
    the noise. If a model that is far off leaves too few of them, all unclipped pixels are used.

    If the camera's curve is stated to be sRGB's, the noise is estimated before the curve, where it
    grows with the light. After the curve, ink is noisier than paper, which `estimate_noise` rules
    out where ink is hardly seen.

    `residual_share` is the share of a pixel's variance that is left in its residual.
    """
    limits, is_seen = sample.censoring, ~sample.censoring.is_clipped
    residuals = (sample.levels - levels) / np.sqrt(residual_share)
    step = sample.window.levels_per_count
    slope = srgb_slope(srgb_decoded(levels)) if sample.is_noise_of_light else np.ones_like(levels)
    usable, margin = is_seen, np.zeros_like(levels)
    for _ in range(2):
        chosen = is_seen & (levels > limits.low + margin) & (levels < limits.high - margin)
        if np.count_nonzero(chosen) >= _FEWEST_OF_NOISE:
            usable = chosen
        of_light = estimate_noise(
            residuals / slope,
            share,
            usable,
            step / slope.max(),
            from_edges=True,
            is_linear_in_share=not sample.level_model.tone.is_shaped,
        )
        noise = GreyNoise(of_light.sd * slope, of_light.plateau_sd * slope)
        if is_seen.all():
            break
        margin = np.minimum(_CLIP_SIGMAS * noise.sd, _MOST_MARGIN * (limits.high - limits.low))
    return noise


def _minimise(
    sample: DiscSample, state: DiscState, free: DiscUnknowns, sd: FloatArray, linear: Linear
) -> DiscFit:
    """Take damped Gauss-Newton steps (Levenberg-Marquardt) from a linearised state."""
    fit, damping = disc_fit_at(sample, state, free, sd, linear), _DAMPING
    total = fit.misfit.total + free.penalty(fit.state.vector)
    for _ in range(_STEPS):
        step, promised = newton_step(fit, damping)
        if promised < _LEAST_PROMISE:
            break
        trial = disc_fit_at(sample, fit.state.moved(step, free.tone), free, sd)
        trial_total = trial.misfit.total + free.penalty(trial.state.vector)
        if trial_total <= total:
            fit, total, damping = trial, trial_total, max(0.1 * damping, _DAMPING)
            continue
        damping = max(10.0 * damping, _DAMPED)
        if damping > _MOST_DAMPING:
            break
    return fit


def newton_step(fit: DiscFit, damping: float) -> tuple[FloatArray, float]:
    """Return a step (21,) and the gain that it promises."""
    free = fit.free
    gradient = fit.gradient
    damped = fit.normal.copy()
    damped[np.diag_indices_from(damped)] *= 1.0 + damping
    _, solution, failure = dposv(damped, gradient)
    promised = 0.5 * float(gradient @ solution)
    if failure or not math.isfinite(promised):
        raise NoFit
    step = np.zeros(COUNT)
    step[free.rows] = solution
    return step, promised
