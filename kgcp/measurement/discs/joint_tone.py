"""Discs adjusted as one problem: all share the camera's tone curve and its sharpening.

The unknowns of each disc alone (ellipse, blur and light) are eliminated disc by disc with the Schur
complement, so that a step costs no more than one step of every disc.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.discs.affine_model import mean_radius_px
from kgcp.measurement.discs.compressed_fit import (
    ObservedNoise,
    compressed_fit_at,
    noise_before_compression,
    pixels_before_compression,
)
from kgcp.measurement.discs.covariance import KURTOSIS_SD, levels_by_kurtosis
from kgcp.measurement.discs.disc_levels import COUNT
from kgcp.measurement.discs.fit_disc import (
    CAMERA_ROWS,
    DiscFit,
    DiscSample,
    DiscState,
    DiscUnknowns,
    NoFit,
    ProcessingPrior,
    noise_at,
)
from kgcp.measurement.discs.tone_curve import WAVES, wave_limits
from kgcp.measurement.image_model.compression import CompressedPixels
from kgcp.measurement.image_model.noise import misfit
from kgcp.measurement.image_model.photometry import Tone

_STEPS, _NOISE_ROUNDS = 25, 2
# Most rounds in which the noise before compression is estimated. They end when a round changes the
# noise by less than the second, as a share, and the shared parameters by less than the third. Discs
# of R 5 px with film's curve need 7 to 14 rounds.
_COMPRESSION_ROUNDS, _SETTLED_NOISE, _SETTLED = 40, 0.05, 0.003
_LEAST_PROMISE = 0.1  # a step that promises a smaller gain in log-likelihood is not taken
_DAMPING, _DAMPED, _MOST_DAMPING = 1e-6, 1e-3, 1e3
_SHARED = np.array(CAMERA_ROWS)
# The point spread of a lens out of focus is more than a kurtosis. The rest displaces burnt edges
# like this share of the kurtosis.
_UNSEEN_OF_KURTOSIS = 0.3
# Median of χ² by its degrees of freedom; with none, discs share nothing to contradict each other in
_MEDIAN_CHI2 = {0: 1.0, 1: 0.455, 4: 3.357}


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """Discs adjusted together."""

    tone: Tone
    sharpening_px: float  # σ of the camera's unsharp mask
    fits: tuple[DiscFit, ...]
    loss: float  # negative log-likelihood with the prior of usual cameras, for a given noise
    precision: FloatArray  # (4, 4): of the shared parameters, in the order of `CAMERA_ROWS`
    scores: FloatArray  # (k, 4): of each disc, by the shared ones; their sum balances the prior's
    informations: FloatArray  # (k, 4, 4): expected covariances of these scores
    is_settled: bool = True  # whether noise and curve settled before the rounds were used up

    @property
    def shared(self) -> FloatArray:
        """What the discs share (4,)."""
        return np.asarray(self.fits[0].state.vector[_SHARED])

    @property
    def excess(self) -> float:
        """Variance of discs' contradictions relative to that of their noise; at least 1."""
        own = self.informations[0].any(axis=0)
        squares = [
            float(score[own] @ np.linalg.lstsq(information[np.ix_(own, own)], score[own])[0])
            for score, information in zip(self.scores, self.informations, strict=True)
        ]
        return max(float(np.median(squares)) / _MEDIAN_CHI2[int(own.sum())], 1.0)

    @property
    def prior(self) -> ProcessingPrior:
        """What the discs say of the camera.

        The precision is divided by the excess by which discs contradict each other.
        """
        return ProcessingPrior(self.shared, self.precision / self.excess)

    def spread_px(self, others: Sequence[JointFit]) -> float:
        """Return the RMS difference of the radii by other curves, by their likelihood [px]."""
        radii, own = np.array([each.radii_px for each in others]), self.radii_px
        losses = np.array([each.loss for each in others])
        weights = np.exp((losses.min() - losses) / self.excess)
        return float(np.sqrt(np.average(np.mean((radii - own) ** 2, axis=1), weights=weights)))

    @property
    def radii_px(self) -> FloatArray:
        """Mean radii of the discs (k,)."""
        return np.array([mean_radius_px(fit.state.geometry) for fit in self.fits])


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """Normal equations of the c parameters that k discs share, with all others eliminated."""

    is_shared: BoolArray  # (p,)
    normals: FloatArray  # (k, c, c)
    gradients: FloatArray  # (k, c)
    # of the r = p − c unknowns of each disc alone
    inverse_others: FloatArray  # (k, r, r)
    between: FloatArray  # (k, c, r)
    own_gradients: FloatArray  # (k, r)


def adjust_together(
    samples: Sequence[DiscSample],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
    sds: Sequence[FloatArray],
) -> JointFit:
    """Adjust discs together, from states with the same shared parameters.

    Parameters
    ----------
    sds : sequence of (n,) arrays
        Noise of each disc's pixels as level, with which the loss is computed. It must be the same
        for all curves that are compared. With the noise of their own residuals, which differs by
        chance, curves would become likelier by up to 40 for forty discs.

    Raises
    ------
    NoFit
        If the equations cannot be solved.
    """
    free, usual = _unknowns(tone, sharpening_px), ProcessingPrior.usual()
    for _ in range(_NOISE_ROUNDS):
        own_sds = [noise_at(*pair).sd for pair in zip(samples, states, strict=True)]
        fits = _minimised(samples, states, free, usual, own_sds)
        states = [fit.state for fit in fits]
    loss = sum(_misfit_by(fit, sd) for fit, sd in zip(fits, sds, strict=True))
    loss += _penalty(fits[0].state.vector[_SHARED], usual)
    return _joint(fits, sharpening_px, loss, is_settled=True)


def adjust_before_compression(
    samples: Sequence[DiscSample],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
    steps: Sequence[FloatArray | None],
    sds: Sequence[FloatArray] | None = None,
) -> JointFit:
    """Adjust discs of compressed photographs to the intervals of their rounded coefficients.

    Parameters
    ----------
    samples, states, tone, sharpening_px
        As for `adjust_together`.
    steps : sequence of (8, 8) arrays
        Of each disc's photograph, by `quantisation_steps`; None: it was not compressed.
    sds : sequence of (n,) arrays, optional
        Noise of each disc's pixels before compression; by default, it is estimated in rounds. Only
        losses with the same noise can be compared.

    Raises
    ------
    NoFit, numpy.linalg.LinAlgError
        If the equations cannot be solved.
    """
    free, usual = _unknowns(tone, sharpening_px), ProcessingPrior.usual()
    pixels = [
        None if of_photograph is None else pixels_before_compression(sample, of_photograph)
        for sample, of_photograph in zip(samples, steps, strict=True)
    ]
    if sds is not None:
        fits = _minimised(samples, states, free, usual, sds, pixels)
        return _joint(fits, sharpening_px, _total(fits, usual), is_settled=True)
    noise, before = [noise_at(*pair).sd for pair in zip(samples, states, strict=True)], None
    is_settled = False
    for _ in range(_COMPRESSION_ROUNDS):
        fits = _minimised(samples, states, free, usual, noise, pixels)
        states, shared = [fit.state for fit in fits], fits[0].state.vector[_SHARED]
        noise_before = noise
        noise = [noise_before_compression(*pair) for pair in zip(fits, pixels, strict=True)]
        change = max(
            abs(float(now.sum() / then.sum()) - 1.0)
            for now, then in zip(noise, noise_before, strict=True)
        )
        has_moved = before is None or np.abs(shared - before).max() > _SETTLED
        is_settled, before = change < _SETTLED_NOISE and not has_moved, shared
        if is_settled:
            break
    return _joint(fits, sharpening_px, _total(fits, usual), is_settled=is_settled)


def _unknowns(tone: Tone, sharpening_px: float) -> DiscUnknowns:
    """Return the unknowns of a disc without the prior of usual cameras: it counts once for all."""
    usual = ProcessingPrior.usual()
    nothing = replace(usual, precision=np.zeros_like(usual.precision))
    return DiscUnknowns.of(tone, nothing, sharpening_px=sharpening_px)


def _joint(
    fits: Sequence[DiscFit], sharpening_px: float, loss: float, *, is_settled: bool
) -> JointFit:
    """Collect discs that are adjusted together."""
    free, usual = fits[0].free, ProcessingPrior.usual()
    own = np.isin(_SHARED, free.rows)
    reduced = _reduced(fits, 0.0)
    count = len(CAMERA_ROWS)
    scores, informations = np.zeros((len(fits), count)), np.zeros((len(fits), count, count))
    scores[:, own] = reduced.gradients
    informations[np.ix_(np.arange(len(fits)), own, own)] = reduced.normals
    precision = usual.precision + informations.sum(axis=0)
    return JointFit(
        free.tone, sharpening_px, tuple(fits), loss, precision, scores, informations, is_settled
    )


def _minimised(
    samples: Sequence[DiscSample],
    states: Sequence[DiscState],
    free: DiscUnknowns,
    usual: ProcessingPrior,
    sds: Sequence[FloatArray],
    pixels: Sequence[CompressedPixels | None] | None = None,
) -> list[DiscFit]:
    """Take damped Gauss-Newton steps of all discs together.

    After each, every disc takes a step of its own, with the shared parameters fixed. Tone curve,
    blur and levels form a narrow, bent valley, and a step of all parameters ends on its slope.

    Parameters
    ----------
    pixels : sequence of CompressedPixels, optional
        Compressed pixels of each disc; None: it was not compressed.
    """
    pixels = [None] * len(samples) if pixels is None else pixels
    frees = [sample.unknowns(free) for sample in samples]
    noises = [ObservedNoise.of(*of_disc) for of_disc in zip(sds, pixels, strict=True)]

    def at(places: Sequence[DiscState]) -> list[DiscFit]:
        each = zip(samples, places, frees, noises, strict=True)
        return [compressed_fit_at(*of_disc) for of_disc in each]

    def moved(fits: Sequence[DiscFit], steps: FloatArray) -> list[DiscFit]:
        pairs = zip(fits, steps, strict=True)
        return at([fit.state.moved(step, free.tone) for fit, step in pairs])

    fits, damping = at(states), _DAMPING
    total = _total(fits, usual)
    for _ in range(_STEPS):
        steps, promised = _steps(fits, usual, damping)
        if promised < _LEAST_PROMISE:
            break
        trial = moved(fits, steps)
        settled = moved(trial, _own_steps(trial))
        trial = [min(pair, key=_own_total) for pair in zip(trial, settled, strict=True)]
        is_near = all(map(_is_near, trial, states))
        trial_total = _total(trial, usual) if is_near else math.inf
        if trial_total <= total:
            fits, total, damping = trial, trial_total, max(0.1 * damping, _DAMPING)
            continue
        damping = max(10.0 * damping, _DAMPED)
        if damping > _MOST_DAMPING:
            break
    return fits


def _is_near(fit: DiscFit, start: DiscState) -> bool:
    """Tell whether a disc is still near the place where the adjustment began.

    A disc that ran away would make its equations singular, and with them the common ones.
    """
    moved_px = np.abs(fit.state.geometry - start.geometry).max()
    return bool(moved_px <= mean_radius_px(start.geometry))


def _own_total(fit: DiscFit) -> float:
    """Return the negative log-likelihood of a disc with the priors of its own unknowns."""
    return fit.misfit.total + fit.free.penalty(fit.state.vector)


def _total(fits: Sequence[DiscFit], usual: ProcessingPrior) -> float:
    own = sum(_own_total(fit) for fit in fits)
    return own + _penalty(fits[0].state.vector[_SHARED], usual)


def _misfit_by(fit: DiscFit, sd: FloatArray) -> float:
    """Return the negative log-likelihood of a fit's pixels with given noise, up to a constant."""
    return misfit(fit.sample.levels, fit.levels, sd, fit.sample.censoring).total


def _penalty(shared: FloatArray, usual: ProcessingPrior) -> float:
    off = shared - usual.mean
    return 0.5 * float(off @ usual.precision @ off)


def _own_steps(fits: Sequence[DiscFit]) -> FloatArray:
    """Return steps (k, 21) of the unknowns of each disc alone."""
    rows = fits[0].free.rows
    own = np.flatnonzero(~np.isin(rows, _SHARED))
    normals = np.array([fit.normal[np.ix_(own, own)] for fit in fits])
    gradients = np.array([fit.gradient[own] for fit in fits])
    steps = np.zeros((len(fits), COUNT))
    steps[:, rows[own]] = np.linalg.solve(normals, gradients[:, :, None])[:, :, 0]
    return steps


def _reduced(fits: Sequence[DiscFit], damping: float) -> _Reduced:
    """Eliminate the unknowns of each disc alone. All discs have the same unknowns."""
    is_shared = np.isin(fits[0].free.rows, _SHARED)
    order = np.argsort(~is_shared, kind="stable")  # the shared ones first
    count = np.count_nonzero(is_shared)
    normals = np.array([fit.normal for fit in fits])
    diagonal = np.arange(len(order))
    normals[:, diagonal, diagonal] *= 1.0 + damping
    normals = normals[:, order[:, None], order]
    gradients = np.array([fit.gradient for fit in fits])[:, order]
    between, own_gradients = normals[:, :count, count:], gradients[:, count:]
    inverse = np.asarray(np.linalg.inv(normals[:, count:, count:]))
    explained = between @ inverse
    return _Reduced(
        is_shared,
        normals[:, :count, :count] - explained @ between.transpose(0, 2, 1),
        gradients[:, :count] - (explained @ own_gradients[:, :, None])[:, :, 0],
        inverse,
        between,
        own_gradients,
    )


def likeliest_along(
    at: Callable[[float], JointFit | None], first: JointFit, most_steps: int
) -> tuple[float, JointFit]:
    """Return the number of steps at which discs are likeliest, and the fit there.

    Steps are taken one by one; a parabola through the best and its neighbours refines the result.

    Parameters
    ----------
    at : callable
        Returns the fit after a number of steps, which need not be whole; None if it fails.
    first : JointFit
        The fit after 0 steps.
    """
    tried = {0: first}
    for direction in (1, -1):
        step = direction
        while abs(step) <= most_steps:
            other = at(step)
            if other is None:
                break
            tried[step] = other
            if other.loss > tried[step - direction].loss:
                break
            step += direction
        if min(tried, key=lambda step: tried[step].loss):  # this was the right direction
            break
    best = min(tried, key=lambda step: tried[step].loss)
    if best - 1 not in tried or best + 1 not in tried:
        return best, tried[best]
    before, middle, after = (tried[best + k].loss for k in (-1, 0, 1))
    bend = before + after - 2.0 * middle
    if bend > 0.0:
        least = best + 0.5 * (before - after) / bend
        between = at(least)
        if between is not None and between.loss < middle:
            return least, between
    return best, tried[best]


def kurtosis_sd(joint: JointFit) -> float:
    """Return by how much the excess kurtosis of the point spread may be another than that used.

    It is the root of the mean square for the discs that were adjusted together, by one step from
    the kurtosis used, and with what is known of any camera.
    """
    reduced, usual = _reduced(joint.fits, 0.0), ProcessingPrior.usual()
    own = np.isin(_SHARED, joint.fits[0].free.rows)
    normal = usual.precision[np.ix_(own, own)] + reduced.normals.sum(axis=0)
    information, score, with_shared = 0.0, 0.0, np.zeros(np.count_nonzero(own))
    for fit, inverse, between in zip(
        joint.fits, reduced.inverse_others, reduced.between, strict=True
    ):
        slopes = levels_by_kurtosis(fit) / fit.sd
        terms = fit.scaled @ (fit.misfit.weight * slopes)
        shared, others = terms[reduced.is_shared], terms[~reduced.is_shared]
        information += float(fit.misfit.weight @ slopes**2 - others @ inverse @ others)
        with_shared += shared - between @ inverse @ others
        score += float(slopes @ fit.misfit.score)
    information -= float(with_shared @ np.linalg.solve(normal, with_shared))
    precision = information / joint.excess + KURTOSIS_SD**-2
    off = score / joint.excess / precision
    kurtosis = joint.fits[0].sample.pixels.kurtosis
    return math.hypot(off, precision**-0.5, _UNSEEN_OF_KURTOSIS * kurtosis)


def within_limits(step: FloatArray, normal: FloatArray, now: FloatArray, tone: Tone) -> FloatArray:
    """Return the step (k,) of the shared parameters that gains most and keeps the curve plausible.

    It has the least distance from the free step in the metric of the normal equations (Lawson &
    Hanson, "Solving least squares problems", 1974, chapter 23: LDP). If free steps were merely cut
    off, they would end where they first meet a limit, not at the best curve along it.

    Parameters
    ----------
    step : (k,) array
        Free step, in the order of `CAMERA_ROWS`; the waves come first.
    normal : (k, k) array
        Normal matrix of the equations that it solves.
    now : (k,) array
        Shared parameters before the step.
    tone : Tone
        A bent curve.

    Raises
    ------
    NoFit
        If the step is not finite, or no step along the limits is found.
    """
    if not np.isfinite(step).all():
        raise NoFit
    of_waves, least = wave_limits(tone)
    short = least - of_waves @ (now + step)[:WAVES]
    if short.max() <= 0.0:
        return step
    from scipy.optimize import nnls  # 0.1 s to import, which flights do not need

    root = np.linalg.cholesky(normal)
    rows = np.pad(of_waves, ((0, 0), (0, len(step) - WAVES)))
    across = np.linalg.solve(root, rows.T)
    try:
        multipliers, _ = nnls(np.vstack((across, short)), np.append(np.zeros(len(step)), 1.0))
    except RuntimeError:  # too many iterations
        raise NoFit from None
    back = np.linalg.solve(root.T, across @ multipliers)
    return step + np.asarray(back) / (1.0 - float(short @ multipliers))


def _steps(
    fits: Sequence[DiscFit], usual: ProcessingPrior, damping: float
) -> tuple[FloatArray, float]:
    """Return steps (k, 21) of all discs, and the gain that they promise together."""
    free = fits[0].free
    own = np.isin(_SHARED, free.rows)
    precision = usual.precision[np.ix_(own, own)]
    off = (usual.mean - fits[0].state.vector[_SHARED])[own]
    try:
        reduced = _reduced(fits, damping)
        gradient = precision @ off + reduced.gradients.sum(axis=0)
        normal = precision + reduced.normals.sum(axis=0)
        shared = np.linalg.solve(normal, gradient)
        if free.tone.is_shaped:
            now = fits[0].state.vector[_SHARED][own]
            shared = within_limits(shared, normal, now, free.tone)
    except np.linalg.LinAlgError:
        raise NoFit from None
    inverse, own_gradients = reduced.inverse_others, reduced.own_gradients
    steps = np.zeros((len(fits), COUNT))
    steps[:, free.rows[reduced.is_shared]] = shared
    left = own_gradients - shared @ reduced.between
    steps[:, free.rows[~reduced.is_shared]] = (inverse @ left[:, :, None])[:, :, 0]
    promised = float(gradient @ shared - 0.5 * shared @ normal @ shared)
    promised += 0.5 * float(np.einsum("ki,kij,kj->", own_gradients, inverse, own_gradients))
    if not math.isfinite(promised):
        raise NoFit
    return steps, promised
