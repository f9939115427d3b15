"""The adjustment: pose, blur and light from the grey values around all circles of a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.target.coverage import white_level, white_share
from kgcp.target.light import PARAM_COUNT, Light, Parameters, light_of_levels
from kgcp.target.noise import Misfit, Noise, estimate_noise, misfit
from kgcp.target.pairs import Blur
from kgcp.target.plate import PlateView, view_plate
from kgcp.target.sample import Imaging, Sample, choose_sample

_MAX_ROUNDS = 4
_EARLY_STEPS, _STEPS = 4, 8
_EARLY_GAIN, _LAST_GAIN = 2.0, 0.05  # of log-likelihood; the error left is its square, about
_SETTLED_BLUR, _SETTLED_NOISE, _SETTLED_PX = 0.15, 0.2, 0.4
_LARGE_GAIN = 4.0
_NEGLIGIBLE = 1e-6
_DAMPING = 1e-3
_MAX_DAMPING = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A sample under given parameters.

    Attributes
    ----------
    view : PlateView
    share : (n,) array
        White share.
    levels : (n,) array
        Grey values before clipping.
    """

    view: PlateView
    share: FloatArray
    levels: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Which parameters are estimated, and what is known of them beforehand.

    Attributes
    ----------
    free : (p,) array of int
        Estimated parameters, by `Param`.
    mean, precision : (19,) array
        Independent normal priors on the nuisance parameters; precision 0: none.
    """

    free: IndexArray
    mean: FloatArray
    precision: FloatArray

    def penalty(self, parameters: Parameters) -> float:
        """Return the priors' part of the negative log-likelihood."""
        deviation = parameters.nuisance_vector - self.mean
        return float(0.5 * (self.precision * deviation * deviation).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The state of an adjustment.

    Attributes
    ----------
    sample : Sample
    parameters : Parameters
    prediction : Prediction
    jacobian : (19, n) array
    sd : (n,) array
        Noise of every pixel, as level.
    misfit : Misfit
        Without the priors.
    unknowns : Unknowns
    normal : (p, p) array
        Normal matrix, priors included.
    """

    sample: Sample
    parameters: Parameters
    prediction: Prediction
    jacobian: FloatArray
    sd: FloatArray
    misfit: Misfit
    unknowns: Unknowns
    normal: FloatArray

    @property
    def total(self) -> float:
        """Negative log-likelihood with the priors."""
        return self.misfit.total + self.unknowns.penalty(self.parameters)


def predict(sample: Sample, parameters: Parameters) -> Prediction:
    """Model the grey values of a sample."""
    view = view_plate(parameters.pose, sample.normalised, sample.normalised_from_px)
    share = white_level(view, parameters.blur, sample.pairs)
    return Prediction(view, share, sample.imager.levels(share, parameters.light))


def linearise(sample: Sample, parameters: Parameters) -> tuple[Prediction, FloatArray]:
    """Model the grey values of a sample, and return their Jacobian (19, n) with them."""
    view = view_plate(parameters.pose, sample.normalised, sample.normalised_from_px)
    share = white_share(view, parameters.blur, sample.pairs)
    levels, jacobian = sample.imager.linearised(share, parameters.light)
    return Prediction(view, share.value, levels), jacobian


def first_levels(sample: Sample, pose: Pose, blur: Blur) -> Light:
    """Return black and white as medians of what an approximate pose takes for ink and plate.

    Raises
    ------
    Rejection
        `NO_CONTRAST` if ink is not darker than the plate.
    """
    view = view_plate(pose, sample.normalised, sample.normalised_from_px)
    share = white_level(view, blur, sample.pairs)
    levels = sample.levels
    black = float(np.median(levels[share <= max(0.1, np.quantile(share, 0.1))]))
    white = float(np.median(levels[share >= min(0.9, np.quantile(share, 0.9))]))
    if white - black < 4.0 * sample.imaging.window.levels_per_count:
        raise Rejection(Reason.NO_CONTRAST, f"ink {black:.3f}, plate {white:.3f}")
    return light_of_levels(black, white, sample.imaging.response)


def adjust(
    imaging: Imaging, start: Parameters, unknowns: Unknowns, sample: Sample | None = None
) -> Fit:
    """Estimate the unknowns, in rounds: pixels, noise and outliers are settled anew in each.

    Parameters
    ----------
    imaging : Imaging
    start : Parameters
    unknowns : Unknowns
    sample : Sample, optional
        The pixels of the first round.

    Raises
    ------
    Rejection
        As `choose_sample`; `POOR_FIT` if the steps diverge.
    """
    parameters = start
    for number in range(_MAX_ROUNDS):
        if sample is None:
            sample = choose_sample(imaging, parameters.pose, parameters.blur, parameters.light)
        linear = linearise(sample, parameters)
        sd = noise_of(sample, linear[0]).sd
        is_first = number == 0
        fit = minimise(
            sample,
            parameters,
            sd,
            unknowns,
            steps=_EARLY_STEPS if is_first else _STEPS,
            enough=_EARLY_GAIN if is_first else _LAST_GAIN,
            linear=linear,
        )
        if not is_first and _is_settled(parameters, fit):
            break
        parameters, sample = fit.parameters, None
    return fit


def _is_settled(before: Parameters, fit: Fit) -> bool:
    """Tell whether the pixels and the noise of a round are right for what it found."""
    imaging, after = fit.sample.imaging, fit.parameters
    blur = after.blur.largest_sd_px / before.blur.largest_sd_px
    noise = float(np.median(noise_of(fit.sample, fit.prediction).sd / fit.sd))
    shift_m = after.pose.translation_m - before.pose.translation_m
    distance_m = after.pose.distance_m
    across_px = float(np.linalg.norm(shift_m[:2])) / distance_m * imaging.focal_px
    growth_px = abs(float(shift_m[2])) / distance_m * imaging.outer_radius_px
    return (
        abs(blur - 1.0) < _SETTLED_BLUR
        and abs(noise - 1.0) < _SETTLED_NOISE
        and max(across_px, growth_px) < _SETTLED_PX
    )


def noise_of(sample: Sample, prediction: Prediction) -> Noise:
    """Return the noise of every pixel of a sample, from its residuals."""
    usable = ~(sample.censoring.at_high | sample.censoring.at_low)
    return estimate_noise(
        sample.levels - prediction.levels,
        prediction.share,
        usable,
        sample.imaging.window.levels_per_count,
    )


def minimise(
    sample: Sample,
    parameters: Parameters,
    sd: FloatArray,
    unknowns: Unknowns,
    *,
    steps: int,
    enough: float,
    linear: tuple[Prediction, FloatArray] | None = None,
) -> Fit:
    """Minimise the negative log-likelihood by damped Gauss-Newton steps (Levenberg-Marquardt).

    At most `steps` of them, and none after one that gained less than `enough`. The Jacobian is made
    anew only while steps are large: near the minimum it hardly changes, and costs most.
    """
    damping = _DAMPING
    prediction, jacobian = linearise(sample, parameters) if linear is None else linear
    current = misfit(sample.levels, prediction.levels, sd, sample.censoring)
    total = current.total + unknowns.penalty(parameters)
    for number in range(steps):
        normal, gradient = _normal_equations(jacobian, parameters, sd, current, unknowns)
        while True:
            step = np.zeros(PARAM_COUNT)
            damped = _solve(normal + damping * np.diag(np.diag(normal)), gradient)
            step[unknowns.free] = damped
            candidate = parameters.moved(step)
            is_large = 0.5 * float(gradient @ damped) > _LARGE_GAIN
            if is_large and number < steps - 1:
                attempt, attempt_jacobian = linearise(sample, candidate)
            else:
                attempt, attempt_jacobian = predict(sample, candidate), jacobian
            trial = misfit(sample.levels, attempt.levels, sd, sample.censoring)
            trial_total = trial.total + unknowns.penalty(candidate)
            if trial_total <= total + _NEGLIGIBLE or damping > _MAX_DAMPING:
                break
            damping *= 10.0
        if trial_total > total + _NEGLIGIBLE:
            break
        gain, total = total - trial_total, trial_total
        parameters, prediction, jacobian, current = candidate, attempt, attempt_jacobian, trial
        damping = max(0.1 * damping, 1e-9)
        if gain < enough:
            break
    normal, _ = _normal_equations(jacobian, parameters, sd, current, unknowns)
    return Fit(sample, parameters, prediction, jacobian, sd, current, unknowns, normal)


def _normal_equations(
    jacobian: FloatArray,
    parameters: Parameters,
    sd: FloatArray,
    current: Misfit,
    unknowns: Unknowns,
) -> tuple[FloatArray, FloatArray]:
    scaled = jacobian[unknowns.free] / sd
    pull = unknowns.precision * (unknowns.mean - parameters.nuisance_vector)
    normal = (scaled * current.weight) @ scaled.T
    normal += np.diag(unknowns.precision[unknowns.free])
    return normal, scaled @ current.score + pull[unknowns.free]


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        solution = np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError as error:
        raise Rejection(Reason.POOR_FIT, "singular normal equations") from error
    if not np.all(np.isfinite(solution)):
        raise Rejection(Reason.POOR_FIT, "steps are not finite")
    return np.asarray(solution, dtype=np.float64)
