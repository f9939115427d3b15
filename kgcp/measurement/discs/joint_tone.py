"""Discs adjusted as one problem: all share the camera's tone curve and its sharpening.

What is a disc's own, ellipse, blur and light, is eliminated disc by disc (Schur), so that a step
costs no more than one of every disc.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.discs.disc_levels import COUNT
from kgcp.measurement.discs.fit_disc import (
    CAMERA_ROWS,
    DiscFit,
    DiscSample,
    DiscState,
    DiscUnknowns,
    NoFit,
    ProcessingPrior,
    disc_fit_at,
    misfit_by,
    noise_at,
)
from kgcp.measurement.image_model.compression import levels_before
from kgcp.measurement.image_model.photometry import Tone

_STEPS, _NOISE_ROUNDS = 25, 2
# Until nothing that is shared moves more in one round. Forty discs of R 5 px by film's curve need
# 29 rounds at quality 75, of which the last four move it by 0.013 at most.
_COMPRESSION_ROUNDS, _SETTLED = 25, 0.003
_ENOUGH = 0.1  # of log-likelihood, promised by a step
_DAMPING, _DAMPED, _MOST_DAMPING = 1e-6, 1e-3, 1e3
_SHARED = np.array(CAMERA_ROWS)


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """Discs adjusted together."""

    tone: Tone
    sharpening_px: float  # σ of the camera's unsharp mask
    fits: tuple[DiscFit, ...]
    loss: float  # negative log-likelihood, with what is usual of cameras, by noise that is given
    precision: FloatArray  # (4, 4): of what they share, in the order of `CAMERA_ROWS`
    scores: FloatArray  # (k, 4): of each disc, by what is shared; they add up to the prior's
    informations: FloatArray  # (k, 4, 4): their expected covariances

    @property
    def shared(self) -> FloatArray:
        """What the discs share (4,)."""
        return np.asarray(self.fits[0].state.vector[_SHARED])


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """Normal equations of what is shared, with all else eliminated."""

    is_shared: BoolArray  # (p,)
    normals: list[FloatArray]  # (c, c) of each disc
    gradients: list[FloatArray]
    inverse_others: list[FloatArray]
    between: list[FloatArray]
    own_gradients: list[FloatArray]


def adjust_together(
    samples: Sequence[DiscSample],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
    sds: Sequence[FloatArray],
) -> JointFit:
    """Adjust discs with what they share, from states that share it.

    Parameters
    ----------
    sds : sequence of (n,) arrays
        Noise of each disc's pixels as level, by which the loss is stated: the same for all curves
        that are compared. The noise that their own residuals show differs by chance, and would make
        curves likelier by up to 40 for forty discs.

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
    return _joint(fits, sharpening_px, sds)


def adjust_before_compression(joint: JointFit, steps: Sequence[FloatArray | None]) -> JointFit:
    """Adjust discs of compressed photographs to what they were before (Dempster, Laird & Rubin).

    In turns, the values before compression are what the model and the coefficients let expect,
    and the model is adjusted to them.

    Parameters
    ----------
    joint : JointFit
        The same discs adjusted to the compressed values.
    steps : sequence of (8, 8) arrays
        Of each disc's photograph, by `quantisation_steps`; None: it was not compressed.

    Raises
    ------
    NoFit, numpy.linalg.LinAlgError
        If the equations cannot be solved.
    """
    free, usual = _unknowns(joint.tone, joint.sharpening_px), ProcessingPrior.usual()
    fits = list(joint.fits)
    for _ in range(_COMPRESSION_ROUNDS):
        before = fits[0].state.vector[_SHARED]
        samples, sds, left_sds = [], [], []
        for fit, step in zip(fits, steps, strict=True):
            sample, lost = fit.sample, np.zeros(1)
            if step is not None:
                places, photo = sample.pixels.places_px, sample.window.photo
                levels, lost = levels_before(photo, places, fit.levels, fit.sd, step)
                sample = replace(sample, levels=levels)
            samples.append(sample)
            left_sds.append(noise_at(sample, fit.state).sd)
            sds.append(np.sqrt(left_sds[-1] ** 2 + lost))
        fits = _minimised(samples, [fit.state for fit in fits], free, usual, sds)
        if np.abs(fits[0].state.vector[_SHARED] - before).max() < _SETTLED:
            break
    # what is lost tells nothing (the missing information of Orchard & Woodbury)
    telling = [
        disc_fit_at(fit.sample, fit.state, fit.free, fit.sd**2 / left_sd)
        for fit, left_sd in zip(fits, left_sds, strict=True)
    ]
    return _joint(fits, joint.sharpening_px, sds, telling)


def _unknowns(tone: Tone, sharpening_px: float) -> DiscUnknowns:
    """Return the unknowns of a disc without what is usual of cameras: all say that once."""
    usual = ProcessingPrior.usual()
    nothing = replace(usual, precision=np.zeros_like(usual.precision))
    return DiscUnknowns.of(tone, nothing, sharpening_px=sharpening_px)


def _joint(
    fits: Sequence[DiscFit],
    sharpening_px: float,
    sds: Sequence[FloatArray],
    telling: Sequence[DiscFit] | None = None,
) -> JointFit:
    """Collect discs that are adjusted together.

    Parameters
    ----------
    sds : sequence of (n,) arrays
        Noise by which the loss is stated.
    telling : sequence of DiscFit
        The same by the noise that their information is stated by; by default, the one they have.
    """
    free, usual = fits[0].free, ProcessingPrior.usual()
    own = np.isin(_SHARED, free.rows)
    reduced = _reduced(fits, 0.0)
    count = len(CAMERA_ROWS)
    scores, informations = np.zeros((len(fits), count)), np.zeros((len(fits), count, count))
    scores[:, own] = reduced.gradients
    normals = reduced.normals if telling is None else _reduced(telling, 0.0).normals
    informations[np.ix_(np.arange(len(fits)), own, own)] = normals
    loss = sum(misfit_by(fit, sd) for fit, sd in zip(fits, sds, strict=True))
    loss += _penalty(fits[0].state.vector[_SHARED], usual)
    precision = usual.precision + informations.sum(axis=0)
    return JointFit(free.tone, sharpening_px, tuple(fits), loss, precision, scores, informations)


def _minimised(
    samples: Sequence[DiscSample],
    states: Sequence[DiscState],
    free: DiscUnknowns,
    usual: ProcessingPrior,
    sds: Sequence[FloatArray],
) -> list[DiscFit]:
    """Take damped Gauss-Newton steps of all discs together.

    After each, every disc takes a step of its own with what is shared held fast: tone curve, blur
    and levels make a narrow, bent valley, and a step of all parameters at once ends on its slope.
    """

    def at(places: Sequence[DiscState]) -> list[DiscFit]:
        return [
            disc_fit_at(sample, state, sample.unknowns(free), sd)
            for sample, state, sd in zip(samples, places, sds, strict=True)
        ]

    fits, damping = at(states), _DAMPING
    total = _total(fits, usual)
    for _ in range(_STEPS):
        steps, promised = _steps(fits, usual, damping)
        if promised < _ENOUGH:
            break
        trial = at(
            [fit.state.moved(step, free.tone) for fit, step in zip(fits, steps, strict=True)]
        )
        settled = at([fit.state.moved(_own_step(fit), free.tone) for fit in trial])
        trial = [min(pair, key=_own_total) for pair in zip(trial, settled, strict=True)]
        trial_total = _total(trial, usual)
        if trial_total <= total:
            fits, total, damping = trial, trial_total, max(0.1 * damping, _DAMPING)
            continue
        damping = max(10.0 * damping, _DAMPED)
        if damping > _MOST_DAMPING:
            break
    return fits


def _own_total(fit: DiscFit) -> float:
    """Return the negative log-likelihood of a disc with the priors of what is its own."""
    return fit.misfit.total + fit.free.penalty(fit.state.vector)


def _total(fits: Sequence[DiscFit], usual: ProcessingPrior) -> float:
    own = sum(_own_total(fit) for fit in fits)
    return own + _penalty(fits[0].state.vector[_SHARED], usual)


def _penalty(shared: FloatArray, usual: ProcessingPrior) -> float:
    off = shared - usual.mean
    return 0.5 * float(off @ usual.precision @ off)


def _own_step(fit: DiscFit) -> FloatArray:
    """Return a step (21,) of what is a disc's own."""
    own = np.flatnonzero(~np.isin(fit.free.rows, _SHARED))
    step = np.zeros(COUNT)
    step[fit.free.rows[own]] = np.linalg.solve(fit.normal[np.ix_(own, own)], fit.gradient[own])
    return step


def _reduced(fits: Sequence[DiscFit], damping: float) -> _Reduced:
    is_shared = np.isin(fits[0].free.rows, _SHARED)
    made = _Reduced(is_shared, [], [], [], [], [])
    for fit in fits:
        normal, gradient = fit.normal.copy(), fit.gradient
        normal[np.diag_indices_from(normal)] *= 1.0 + damping
        between = normal[np.ix_(is_shared, ~is_shared)]
        inverse = np.asarray(np.linalg.inv(normal[np.ix_(~is_shared, ~is_shared)]))
        made.normals.append(normal[np.ix_(is_shared, is_shared)] - between @ inverse @ between.T)
        made.gradients.append(gradient[is_shared] - between @ (inverse @ gradient[~is_shared]))
        made.inverse_others.append(inverse)
        made.between.append(between)
        made.own_gradients.append(gradient[~is_shared])
    return made


def _steps(
    fits: Sequence[DiscFit], usual: ProcessingPrior, damping: float
) -> tuple[list[FloatArray], float]:
    """Return a step (21,) of every disc, and the gain that they promise together."""
    free = fits[0].free
    own = np.isin(_SHARED, free.rows)
    precision = usual.precision[np.ix_(own, own)]
    off = (usual.mean - fits[0].state.vector[_SHARED])[own]
    try:
        reduced = _reduced(fits, damping)
        gradient = precision @ off + sum(reduced.gradients)
        shared = np.linalg.solve(precision + sum(reduced.normals), gradient)
    except np.linalg.LinAlgError:
        raise NoFit from None
    promised, steps = 0.5 * float(gradient @ shared), []
    for inverse, between, own_gradient in zip(
        reduced.inverse_others, reduced.between, reduced.own_gradients, strict=True
    ):
        step = np.zeros(COUNT)
        step[free.rows[reduced.is_shared]] = shared
        step[free.rows[~reduced.is_shared]] = inverse @ (own_gradient - between.T @ shared)
        promised += 0.5 * float(own_gradient @ inverse @ own_gradient)
        steps.append(step)
    if not np.isfinite(promised):
        raise NoFit
    return steps, promised
