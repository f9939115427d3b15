"""The adjustment: pose, blur and light from the grey values around all circles of a target."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.level_equations import LevelEquations
from kgcp.measurement.adjustment.normal_equations import (
    Equations,
    PlainEquations,
    Unknowns,
    scaled_rows,
)
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.pixels import Sample, select_pixels
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.image_model.blurred_plate import (
    WhiteShare,
    kurtosis_row,
    white_share,
    white_share_without_derivatives,
)
from kgcp.measurement.image_model.edge_terms import skew_rows, spread_share_gradient
from kgcp.measurement.image_model.noise import GreyNoise, Misfit, estimate_noise, misfit
from kgcp.measurement.image_model.photometry import SHAPE_PARAMS

EquationsOf = Callable[[Parameters, FloatArray, Misfit], Equations]

# A fit is settled if a round changes it by little against its deviations. The limits are tight: a
# fit with many unknowns that stops early stays near its start. With limits of 0.4 px and 15 % of
# the blur, and steps that gained down to 0.05 in log-likelihood, distances depended on the start by
# 1 σ, and errors of phones were twice as large (0.065 % at R 13-26 px instead of 0.027 %).
_MAX_ROUNDS = 6
_EARLY_STEPS, _STEPS = 4, 8
# A step that gains less in log-likelihood is the last; the error that it leaves is about its square
_EARLY_GAIN, _LAST_GAIN = 2.0, 0.01
_SETTLED_NOISE, _SETTLED_PX = 0.15, 0.02
_SETTLED_BLUR, _SETTLED_STREAK = 0.02, 0.01
_NOISE_ROUNDS = 3
_SLACK_PX = 0.4  # by which an approximate pose may be off
_LARGE_CHANGE = 0.01  # of the grey values (RMS over the pixels), as a share of the contrast
_STEPS_BEFORE_HOPELESS = 2
_NEGLIGIBLE = 1e-6  # loss of a step that counts as none, in log-likelihood
_AS_PROMISED = 0.02  # a step whose gain differs from its promise by less has reached the minimum
_DAMPING, _DAMPED = 1e-7, 1e-3  # at first; after a step that failed
_MAX_DAMPING = 1e3  # makes steps a thousand times shorter; shorter ones fail as well
_LEAST_CONTRAST = 0.1  # of ink and plate at a pixel, relative to the mean over the plate


@dataclass(frozen=True, slots=True, eq=False)
class PredictedImage:
    """The image of a sample under given parameters."""

    points_m: FloatArray  # (2, n): where the pixels' rays meet the plate
    share: FloatArray  # (n,): white share
    levels: FloatArray  # (n,): grey values before clipping


@dataclass(frozen=True, slots=True, eq=False)
class TargetFit:
    """The state of an adjustment."""

    sample: Sample
    parameters: Parameters
    prediction: PredictedImage
    jacobian: FloatArray  # (rows, n): as of `PhotometricModel.linearised`
    sd: FloatArray  # (n,): noise of every pixel, as level
    misfit: Misfit  # without the priors
    unknowns: Unknowns
    # equations with the levels that vary eliminated; None: the light is even
    level_equations: LevelEquations | None = None

    @property
    def scaled_jacobian(self) -> FloatArray:
        """Jacobian of the free parameters (p, n), in units of the noise."""
        return scaled_rows(self.jacobian, self.unknowns.free, self.sd)

    @property
    def total(self) -> float:
        """Negative log-likelihood with the priors."""
        return negative_log_posterior(self.misfit, self.unknowns, self.parameters)


def moved_to(fit: TargetFit, pose: Pose) -> TargetFit:
    """Return a fit with another pose that is not adjusted; the Jacobian is not computed anew."""
    parameters = fit.parameters.at(pose)
    prediction = predict(fit.sample, parameters)
    current = misfit(fit.sample.levels, prediction.levels, fit.sd, fit.sample.censoring)
    return replace(fit, parameters=parameters, prediction=prediction, misfit=current)


def predict(sample: Sample, parameters: Parameters) -> PredictedImage:
    """Model the grey values of a sample."""
    share = white_share_without_derivatives(
        parameters.matrix, sample.rays, parameters.blur.vector, sample.incidence
    )
    share, added = _with_edge_terms(share, sample, parameters)
    levels = sample.photometry.levels(share.value, parameters.light, added)
    return PredictedImage(share.points_m, share.value, levels)


def linearise(sample: Sample, parameters: Parameters) -> tuple[PredictedImage, FloatArray]:
    """Model the grey values of a sample, and return them with their Jacobian.

    The Jacobian is that of `PhotometricModel.linearised`. Derivatives by skew and kurtosis of the
    point spread are 0 where these are 0.
    """
    share = white_share(parameters.matrix, sample.rays, parameters.blur.vector, sample.incidence)
    share, added = _with_edge_terms(share, sample, parameters)
    levels, jacobian = sample.photometry.linearised(share, parameters.light, added)
    return PredictedImage(share.points_m, share.value, levels), jacobian


def _with_edge_terms(
    share: WhiteShare, sample: Sample, parameters: Parameters
) -> tuple[WhiteShare, FloatArray | None]:
    """Add the effects of a skew point spread, and of light that changes across edges.

    Returns
    -------
    share : WhiteShare
        Derivatives by pose, blur and levels are not corrected: that would change them by a few per
        cent.
    added : (2, n) array or None
        What uneven light adds to the levels of ink and plate; None: the light is even.
    """
    value, jacobian, field = share.value, share.jacobian, parameters.field
    covariance = parameters.blur.total_covariance
    if parameters.has_skew or parameters.has_kurtosis:
        rows = _shape_rows(share, sample, parameters)
        value = value + parameters.vector[SHAPE_PARAMS] @ rows
        jacobian = np.vstack((jacobian, rows)) if len(jacobian) else jacobian
    if field is None:
        return WhiteShare(share.views, value, jacobian), None
    added, gradient = field.added_with_gradient(sample.pixels)
    spread = spread_share_gradient(share.views, covariance, sample.incidence)
    contrast = np.maximum(1.0 + added[1] - added[0], _LEAST_CONTRAST)
    value = value + np.sum(gradient * spread, axis=0) / contrast
    return WhiteShare(share.views, value, jacobian), added


def _shape_rows(share: WhiteShare, sample: Sample, parameters: Parameters) -> FloatArray:
    """Return the derivatives (5, n) of the white share by third and fourth cumulants.

    Derivatives by cumulants that are 0 are left 0.
    """
    rows, blur = np.zeros((len(SHAPE_PARAMS), len(share.value))), parameters.blur
    if parameters.has_skew:
        rows[:-1] = skew_rows(share.views, blur.total_covariance, sample.incidence)
    if parameters.has_kurtosis:
        rows[-1] = kurtosis_row(
            share.value, parameters.matrix, sample.rays, blur.vector, sample.incidence
        )
    return rows


def approach(sample: Sample, start: Parameters, unknowns: Unknowns) -> TargetFit:
    """Come near the minimum from a rough start, on pixels that were chosen for it."""
    return _fit_with_noise(
        sample, start, unknowns, steps=_EARLY_STEPS, least_gain=_EARLY_GAIN, is_near=False
    )


def adjust(
    problem: FitProblem, start: Parameters, unknowns: Unknowns, max_pixels: int | None = None
) -> TargetFit:
    """Estimate the unknowns in rounds, each with its own choice of pixels, noise and outliers.

    If `max_pixels` is given, at most this many are used; if there are more, the estimate is rough.

    Raises
    ------
    Rejection
        As `select_pixels`; `POOR_FIT` if the steps diverge.
    """
    parameters = start
    for _ in range(_MAX_ROUNDS):
        pose, blur, light = parameters.pose, parameters.blur, parameters.light
        sample = select_pixels(
            problem, pose, blur, light, max_pixels=max_pixels, slack_px=_SLACK_PX
        )
        least_gain = _EARLY_GAIN if sample.is_thinned else _LAST_GAIN
        fit = _fit_with_noise(
            sample, parameters, unknowns, steps=_STEPS, least_gain=least_gain, is_near=True
        )
        if _is_settled(parameters, fit):
            break
        parameters = fit.parameters
    return fit


def _fit_with_noise(
    sample: Sample,
    parameters: Parameters,
    unknowns: Unknowns,
    *,
    steps: int,
    least_gain: float,
    is_near: bool,
) -> TargetFit:
    """Minimise and estimate the noise from the residuals in turn, until the noise is settled.

    If the start `is_near` the minimum, the noise shows before the minimum is reached, and the first
    minimisation may stop early. From a start farther away that might lead to a wrong minimum.
    """
    linear = linearise(sample, parameters)
    sd = noise_of(sample, linear[0]).sd
    for number in range(_NOISE_ROUNDS):
        fit = minimise(
            sample,
            parameters,
            sd,
            unknowns,
            steps=steps,
            least_gain=least_gain,
            linear=linear,
            stops_at_new_jacobian=is_near and number == 0,
        )
        parameters, linear = fit.parameters, (fit.prediction, fit.jacobian)
        before, sd = sd, noise_of(sample, fit.prediction).sd
        if abs(float(sd.sum() / before.sum()) - 1.0) < _SETTLED_NOISE:
            break
    return fit


def _is_settled(before: Parameters, fit: TargetFit) -> bool:
    """Tell whether the pixels that were chosen for a round still suit its result.

    The choice depends on blur, direction and size. A move along the ray changes the size alone.
    """
    problem, after = fit.sample.problem, fit.parameters
    blur = after.blur.largest_sd_px / before.blur.largest_sd_px
    (x, y, depth), (x0, y0, depth0) = after.matrix[:, 3].tolist(), before.matrix[:, 3].tolist()
    across_px = math.hypot(x / depth - x0 / depth0, y / depth - y0 / depth0) * problem.focal_px
    growth_px = abs(depth / depth0 - 1.0) * problem.outer_radius_px
    limit = _SETTLED_STREAK if after.blur.has_streak else _SETTLED_BLUR
    return abs(blur - 1.0) < limit and max(across_px, growth_px) < _SETTLED_PX


def noise_of(sample: Sample, prediction: PredictedImage, *, is_even: bool = True) -> GreyNoise:
    """Return the noise of every pixel of a sample, from its residuals.

    If the light is uneven, the noise is not estimated in bands of the white share, since residuals
    then also contain what the levels miss. Pixels that are clipped, or are modelled as clipped, are
    not used: an unbounded white level would inflate its own noise estimate.
    """
    limits, levels = sample.censoring, prediction.levels
    usable = ~limits.is_clipped & (levels > limits.low) & (levels < limits.high)
    return estimate_noise(
        sample.levels - prediction.levels,
        prediction.share,
        usable,
        sample.problem.window.levels_per_count,
        in_bands=is_even and sample.problem.tone.is_curved,
    )


def minimise(
    sample: Sample,
    parameters: Parameters,
    sd: FloatArray,
    unknowns: Unknowns,
    *,
    steps: int,
    least_gain: float,
    linear: tuple[PredictedImage, FloatArray] | None = None,
    large_gain: float = math.inf,
    stops_at_new_jacobian: bool = False,
    hopeless_total: float = math.inf,
    equations_of: EquationsOf | None = None,
) -> TargetFit:
    """Minimise the negative log-likelihood by damped Gauss-Newton steps (Levenberg-Marquardt).

    The Jacobian, and the equations with it, is computed again only after steps that change the grey
    values by more than 1 % of the contrast, or that promise more than `large_gain`. Near the
    minimum it hardly changes, and it takes most of the time.

    Parameters
    ----------
    steps : int
        Most steps.
    least_gain : float
        A step that gains less in log-likelihood is the last.
    linear : PredictedImage and Jacobian, optional
        At the start, if they are known.
    large_gain : float
        See above.
    stops_at_new_jacobian : bool
        Whether a step after which the Jacobian is computed again is the last.
    hopeless_total : float
        The second or a later step is the last if the total is larger than this after it.
    equations_of : callable, optional
        Makes the equations at some parameters; None: those of pose, blur and light.
    """
    damping, light = _DAMPING, parameters.light
    contrast = max(light.white - light.black, sample.problem.window.levels_per_count)
    relative_sd = float(sd.mean()) / contrast
    prediction, jacobian = linearise(sample, parameters) if linear is None else linear
    current = misfit(sample.levels, prediction.levels, sd, sample.censoring)
    total = negative_log_posterior(current, unknowns, parameters)
    equations_of = equations_of or _plain_equations_of(sd, unknowns)
    equations = equations_of(parameters, jacobian, current)
    for number in range(steps):
        rejected = 0
        while True:
            candidate, promised = equations.proposed(current, parameters, damping)
            change = relative_sd * math.sqrt(2.0 * promised / len(sd))
            is_large = change > _LARGE_CHANGE or promised > large_gain
            needs_jacobian = is_large and number < steps - 1
            if needs_jacobian and not rejected:
                attempt, attempt_jacobian = linearise(sample, candidate)
            else:
                attempt, attempt_jacobian = predict(sample, candidate), jacobian
            trial = misfit(sample.levels, attempt.levels, sd, sample.censoring)
            trial_total = negative_log_posterior(trial, unknowns, candidate)
            is_better = trial_total <= total + _NEGLIGIBLE
            if is_better or promised < least_gain or damping > _MAX_DAMPING:
                break
            damping, rejected = max(10.0 * damping, _DAMPED), rejected + 1
        # after a rejected step, the Jacobian is computed only once a candidate is accepted
        if is_better and needs_jacobian and rejected:
            attempt, attempt_jacobian = linearise(sample, candidate)
        if not is_better:
            break
        gain, total = total - trial_total, trial_total
        parameters, prediction, current = candidate, attempt, trial
        is_new, jacobian = attempt_jacobian is not jacobian, attempt_jacobian
        is_hopeless = number + 1 >= _STEPS_BEFORE_HOPELESS and total > hopeless_total
        if is_hopeless or (is_new and stops_at_new_jacobian):
            break
        if gain < least_gain or abs(gain - promised) < _AS_PROMISED:
            break
        if is_new:
            equations = equations_of(parameters, jacobian, current)
        damping = max(0.1 * damping, 1e-9)
    return TargetFit(sample, parameters, prediction, jacobian, sd, current, unknowns)


def _plain_equations_of(sd: FloatArray, unknowns: Unknowns) -> EquationsOf:
    return lambda _, jacobian, current: PlainEquations.of(jacobian, sd, current, unknowns)


def negative_log_posterior(current: Misfit, unknowns: Unknowns, parameters: Parameters) -> float:
    """Return the negative log-likelihood of pixels of known noise, with all priors."""
    of_field = 0.0 if parameters.field is None else parameters.field.penalty
    return current.total + unknowns.penalty(parameters) + of_field
