"""Tone curve, sharpening and focus of a camera, learned from some large discs of its photographs.

A disc alone tells little of them. Where the light falls off, it takes errors of the curve for a
displacement. But all discs share them: some large ones are adjusted together, as one problem in
which each disc has its own ellipse, blur and light. The result is the prior for all discs.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.adjust_disc import (
    DiscRejection,
    DiscTask,
    adjust_disc,
    check_disc_fit,
    is_in_curved_light,
)
from kgcp.measurement.discs.compressed_fit import are_coarse, are_compressed, steps_of
from kgcp.measurement.discs.covariance import KURTOSIS_SD
from kgcp.measurement.discs.disc_levels import Row
from kgcp.measurement.discs.fit_disc import (
    CAMERA_ROWS,
    SHARPENING_PX,
    DiscFit,
    DiscSample,
    DiscState,
    DiscUnknowns,
    NoFit,
    ProcessingPrior,
)
from kgcp.measurement.discs.joint_tone import (
    JointFit,
    adjust_before_compression,
    adjust_together,
    kurtosis_sd,
    likeliest_along,
)
from kgcp.measurement.discs.tone_curve import WAVES
from kgcp.measurement.image_model.photometry import Tone

# How many discs of a photograph are learned from: so many that their radii add up to this, and at
# least this many. Nine dark discs of R 3.5 px under film's curve would be too few: they miss a
# fifth of its second wave, which displaces centres by 0.002 px.
_RADII_PX, _FEWEST_DISCS = 110.0, 9
_LEAST_RADIUS_PX = 5.0  # of discs to learn from, if there are enough
# From this radius on, discs show a gradient of the darker level of its own, unless the curve is
# unknown.
_LARGE_RADIUS_PX = 20.0
_LARGEST_BLUR = 0.3  # of the radius, to start from
# Masks around σ = 1 px are tried in steps of this factor, if the camera sharpens: if the strength
# is at least the first and at least this many standard deviations.
_MASK_STEP, _MOST_STEPS = 1.25, 2
_LEAST_SHARPENING, _SIGNIFICANT = 0.05, 4.0
_BENT = {Tone.SRGB: Tone.UNKNOWN, Tone.LINEAR: Tone.UNKNOWN_OVER_LINE}
# A curve is bent if that gains more than this in twice the log-likelihood. Bends are three
# parameters; noise alone exceeds it once in a thousand times. A straight line that is bent by
# chance makes discs larger or smaller by 1 %.
_SIGNIFICANT_BENDS = 16.0
# The limit is multiplied by this power of the excess by which discs contradict each other. Burnt,
# sharpened photographs have an excess of 4 to 6; their bends gain up to 1200, stand for what the
# model lacks, and displace the discs. Film's curve, with an excess of 1 to 1.5, gains 70 to 800 on
# nine discs (`benchmarks.calibrate.operator`).
_EXCESS_POWER = 3
# If the mask is not quite the camera's, the wrong one of two bent curves may be likelier. So bent
# curves are compared again, each with its own best mask, if they are less likely than the best by
# less than this share of what its bends gain. Others would only win by ties, and would displace
# edges by 0.15 px.
_NEARLY_AS_LIKELY = 0.2
# Where a line is likelier than sRGB's curve, it is the line that is bent, unless bent sRGB is
# likelier than the bent line by more than this share of the line's advantage over sRGB. This is for
# linear cameras under JPEG (`benchmarks.calibrate.operator`).
_LINE_PREFERENCE = 0.25
# A second start for compressed photographs: the S that cameras add for contrast. From the curve of
# the compressed values alone, steps may end in a curve that is less likely by 14.
_MORE_CONTRAST = np.array((0.0, -0.4, 0.0))
# The excess kurtosis of the point spread is tried in steps of 0.2, at most three of them, from 0 (a
# Gaussian) or from three or five steps below 0 (out of focus), whichever is likeliest. With a wrong
# curve, −0.6 may be no likelier than 0, although −1 is. The least is −1.2 (uniform).
_KURTOSIS_STEP, _DEFOCUSED_STEPS, _MOST_KURTOSIS_STEPS = 0.2, (-3.0, -5.0), 3
_LEAST_STEP = -6.0
# A kurtosis is taken if it gains more than this in twice the log-likelihood, times the power of the
# excess: the first by grey values that are not compressed, or by what compression left; the second
# by compressed grey values, if the curve is stated or the discs are few. Gains over that power: in
# focus, 65 to 100 discs have up to 3, and by compressed grey values up to 126. Blurred to discs of
# 2 px radius, they have 500 and more with known curves, and 600 with film's in three of four cases;
# by compressed grey values up to 270; 14 discs with unknown curves have 23 and 30. By what
# compression left, discs in focus lose 8 and more, and 45 discs of R 15 px out of focus gain 220 to
# 410 (`benchmarks.calibrate.operator`).
_SIGNIFICANT_KURTOSIS, _SIGNIFICANT_IN_COMPRESSED = 16.0, 100.0
# Standard deviation of a displacement of all edges, as a share of the blur, if fewer than nine
# discs of a JPEG tell its unknown curve: all curves are off then. Single discs of R 3 px under a
# film curve, quality 92, are off by 0.13 to 0.28 px; the spread of the curves explains 0.16 px.
_BY_COMPRESSION_OF_FEW = 0.3
_LITTLE_BENT = 0.02  # standard deviation of the waves of a curve that counts as not bent


@dataclass(frozen=True, slots=True, eq=False)
class CameraTone:
    """What the camera does to the light of all discs of a photograph."""

    tone: Tone
    sharpening_px: float = 0.0  # σ of its unsharp mask; 0: it does not sharpen
    prior: ProcessingPrior | None = None  # of tone curve and sharpening; None: nothing is learned
    blur_px: float = 0.0  # median of the discs that it was learned from; 0: none
    kurtosis: float = 0.0  # excess kurtosis of its point spread
    kurtosis_sd: float = KURTOSIS_SD  # its standard deviation
    is_curve_unknown: bool = False  # False: the curve is stated
    # By how much edges may be displaced by curves that a few discs do not tell apart [px]
    curve_spread_px: float = 0.0
    is_compressed: bool = False  # whether a photograph is seen to be compressed
    is_reliable: bool = True  # False: compression has left too little to learn from


@dataclass(frozen=True, slots=True, eq=False)
class _Curves:
    """Discs adjusted together with all curves that are possible."""

    plain: Sequence[JointFit]
    bent: Sequence[JointFit]  # none if the curve is stated
    # The likeliest plain curve, bent, adjusted to what JPEG left; None: not compressed, or too few
    # discs to tell a curve
    before_compression: JointFit | None


def learn_tone(photographs: Sequence[Sequence[DiscTask]], response: Response) -> CameraTone:
    """Learn the tone for the discs of one photograph, or of all photographs by one camera.

    1. A kurtosis is looked for with the likeliest curve, or by what JPEG left. If the camera proves
       to be out of focus, all curves are compared with that kurtosis.
    2. An unknown curve is sRGB's or a straight line, whichever makes the same pixels of all discs
       together likelier. It is bent only if that makes them significantly likelier still: where
       white is burnt and black is clipped, little of the curve is seen, and its bends would explain
       what the model of the image lacks.
    3. If the camera sharpens, the width of its mask is adjusted.
    4. If JPEG compressed the photographs, discs are adjusted anew to what it left.
    5. Where white is burnt, an unknown curve that is not bent for all discs may bend a little in
       each.
    """
    tone = Tone.of(response)
    chosen = [task for tasks in photographs for task in _learning_tasks(tasks)]
    fits = _first_fits(chosen, tone)
    is_compressed = are_compressed(fits)
    steps: list[FloatArray | None] = [None] * len(fits)
    if tone is Tone.UNKNOWN and len(fits) >= _FEWEST_DISCS:  # few tell too little of a curve
        steps = steps_of(fits)
    curves = _by_curves(fits, tone, steps)
    sds = [fit.sd for fit in fits]  # the same for all that is compared
    kurtosis = _learned_kurtosis(curves, sds, steps, is_compressed=is_compressed)
    camera = CameraTone(
        tone,
        kurtosis=kurtosis,
        is_curve_unknown=tone is Tone.UNKNOWN,
        is_compressed=is_compressed,
    )
    if kurtosis:
        fits = [_with_kurtosis(fit, kurtosis) for fit in fits]
        curves = _by_curves(fits, tone, steps)
    likeliest = _likeliest(curves.bent or curves.plain)
    if likeliest is not None:
        camera = replace(camera, kurtosis_sd=kurtosis_sd(likeliest))
    if tone is Tone.LINEAR:
        return camera
    best = _likeliest(
        [
            _with_best_mask(joint, partial(_adjusted_together, sds=sds))
            for joint in _worth_comparing(curves.plain, curves.bent)
        ]
    )
    if best is None:
        return replace(camera, sharpening_px=SHARPENING_PX)
    is_reliable, before = True, curves.before_compression
    if before is not None:
        if best.tone.is_shaped or _is_bent(before):
            best = before
        is_reliable = best.is_settled and not are_coarse(steps)
    blur_px = float(np.median([fit.state.blur.mean_sd_px for fit in best.fits]))
    prior = best.prior
    spread_px = 0.0
    if camera.is_curve_unknown and len(fits) < _FEWEST_DISCS:
        by_compression_px = _BY_COMPRESSION_OF_FEW * blur_px * is_compressed
        spread_px = math.hypot(best.spread_px([*curves.plain, *curves.bent]), by_compression_px)
    if camera.is_curve_unknown and not best.tone.is_shaped and _are_burnt(fits):
        # the curve's upper end is not seen: what it may be off stays in the covariances
        prior = _slightly_bent(prior)
        best = replace(best, tone=_BENT[best.tone])
    return replace(
        camera,
        tone=best.tone,
        sharpening_px=best.sharpening_px,
        prior=prior,
        blur_px=blur_px,
        is_reliable=is_reliable,
        curve_spread_px=spread_px,
    )


def unknowns_of_disc(task: DiscTask, camera: CameraTone) -> DiscUnknowns:
    """Return the unknowns of a disc, with what is known of the camera."""
    unknowns = DiscUnknowns.of(
        camera.tone,
        camera.prior,
        sharpening_px=camera.sharpening_px,
        has_ink_slope=not camera.tone.is_shaped and task.radius_px >= _LARGE_RADIUS_PX,
        kurtosis=camera.kurtosis,
        is_curve_unknown=camera.is_curve_unknown,
        is_compressed=camera.is_compressed,
        curve_spread_px=camera.curve_spread_px,
    )
    return replace(unknowns, kurtosis_sd=camera.kurtosis_sd)


def first_blur_px(task: DiscTask, camera: CameraTone) -> float:
    """Return the blur to start from; 0: none is known."""
    return min(camera.blur_px, _LARGEST_BLUR * task.radius_px)


def _learning_tasks(tasks: Sequence[DiscTask]) -> list[DiscTask]:
    """Return the tasks of some large discs of high contrast, evenly drawn from the larger half."""
    large = [task for task in tasks if task.radius_px >= _LEAST_RADIUS_PX]
    count = _FEWEST_DISCS
    if len(large) < min(count, len(tasks)):  # a few large marks may not be like all others
        large = list(tasks)
    if large:
        radius_px = float(np.median([task.radius_px for task in large]))
        count = max(round(_RADII_PX / radius_px), count)
    worth = [task.radius_px * task.outline.contrast for task in large]
    order = sorted(range(len(large)), key=lambda i: (-worth[i], i))
    half = order[: max(len(order) // 2, min(len(order), count))]
    step = max(len(half) // count, 1)
    return [large[i] for i in half[::step][:count]]


def _first_fits(tasks: Sequence[DiscTask], tone: Tone) -> list[DiscFit]:
    """Adjust discs each by itself, with a known curve or sRGB's; return the fits that succeed.

    Burnt discs do not show the upper end of the curve, and the edge of a shadow looks like a bend
    of it: both are left out if enough other discs remain.

    The light over a disc is taken to be linear. A second order would be held fixed while all discs
    are adjusted together, and the curve would be bent to fit it.
    """
    free = DiscUnknowns.of(Tone.LINEAR)
    if tone is not Tone.LINEAR:
        is_stated = tone is Tone.SRGB
        free = DiscUnknowns.of(Tone.SRGB, sharpening_px=SHARPENING_PX, is_tone_stated=is_stated)
    fits, clean = [], []
    for task in tasks:
        with contextlib.suppress(DiscRejection, NoFit, np.linalg.LinAlgError):
            fit = adjust_disc(task, free)
            check_disc_fit(fit, task.outline)
            fits.append(fit)
            if not fit.sample.is_burnt and not is_in_curved_light(fit, task):
                clean.append(fit)
    if tone is Tone.UNKNOWN and len(tasks) == 1 and not clean:
        return [fit for fit in fits if _is_in_even_light_by_line(fit, tasks[0])]
    return clean if len(clean) >= min(_FEWEST_DISCS, len(fits) // 2) else fits


def _is_in_even_light_by_line(fit: DiscFit, task: DiscTask) -> bool:
    """Tell whether a single disc shows no edge of a shadow if the camera is linear.

    By sRGB's curve, the light on discs by linear cameras seems to be curved. Of six single discs of
    R 8 px, two were not learned from, and their edges were displaced by a quarter of the blur.
    """
    if fit.sample.is_burnt:
        return False
    line = DiscUnknowns.of(Tone.LINEAR, sharpening_px=SHARPENING_PX, is_tone_stated=False)
    with contextlib.suppress(DiscRejection, NoFit, np.linalg.LinAlgError):
        return not is_in_curved_light(adjust_disc(task, line), task)
    return False


def _by_curves(fits: Sequence[DiscFit], tone: Tone, steps: Sequence[FloatArray | None]) -> _Curves:
    """Adjust discs together with all curves that are possible.

    Parameters
    ----------
    steps : sequence of (8, 8) arrays
        Of each disc's photograph; None: not compressed, or not needed.
    """
    if tone is not Tone.UNKNOWN:
        return _Curves(_joints(fits, (tone,)), [], None)
    plain, bent = _joints(fits, tuple(_BENT)), _joints(fits, tuple(_BENT.values()))
    before = None
    if plain and any(each is not None for each in steps):
        # Plain curves differ by 100 and more in log-likelihood; bent curves of small discs are
        # equally likely by what compression leaves. But a line cannot be bent to film's curve:
        # centres would be off by 0.006 px.
        base = _BENT[min(plain, key=lambda joint: joint.loss).tone]
        start = next((joint for joint in bent if joint.tone is base), None)
        before = None if start is None else _before_compression(start, steps)
    return _Curves(plain, bent, before)


def _learned_kurtosis(
    curves: _Curves,
    sds: Sequence[FloatArray],
    steps: Sequence[FloatArray | None],
    *,
    is_compressed: bool,
) -> float:
    """Return the excess kurtosis of the camera's point spread; 0: none is significant.

    Parameters
    ----------
    curves : _Curves
        Without kurtosis.
    sds : sequence of (n,) arrays
        As for `adjust_together`.
    steps : sequence of (8, 8) arrays
        As for `_by_curves`.
    """
    before, in_focus = curves.before_compression, _likeliest(curves.bent or curves.plain)
    if before is not None:
        again = partial(
            _adjusted_before_compression, steps=steps, sds=[fit.sd for fit in before.fits]
        )
        return _likeliest_kurtosis(before, partial(_from_both_starts, again), _SIGNIFICANT_KURTOSIS)
    if in_focus is None:
        return 0.0
    least_gain = _SIGNIFICANT_IN_COMPRESSED if is_compressed else _SIGNIFICANT_KURTOSIS
    return _likeliest_kurtosis(in_focus, partial(_adjusted_together, sds=sds), least_gain)


def _likeliest_kurtosis(
    in_focus: JointFit, adjusted: Callable[..., JointFit | None], least_gain: float
) -> float:
    """Return the excess kurtosis of the point spread that makes all discs together likeliest.

    It is 0 unless a negative one, that of a camera out of focus, is significantly likelier. A
    positive one would mean long tails. Discs that another program rendered with jagged edges seem
    to have 0.6; with it, a focal length of 6673 px was off by 1.0 instead of 0.9 px.

    Parameters
    ----------
    in_focus : JointFit
        Discs without kurtosis, with the likeliest curve.
    adjusted : callable
        Adjusts discs, given fits, states, a curve and the σ of a mask; None if that fails.
    least_gain : float
        In twice the log-likelihood, times a power of the excess.
    """

    def at(step: float) -> JointFit | None:
        if not _LEAST_STEP <= step <= 0.0:
            return None
        changed = [_with_kurtosis(fit, step * _KURTOSIS_STEP) for fit in in_focus.fits]
        return adjusted(changed, states, in_focus.tone, in_focus.sharpening_px)

    states = [fit.state for fit in in_focus.fits]
    begin, first = 0.0, in_focus
    for step in _DEFOCUSED_STEPS:
        defocused = at(step)
        if defocused is not None and defocused.loss < first.loss:
            begin, first = step, defocused
    steps, best = likeliest_along(lambda steps: at(begin + steps), first, _MOST_KURTOSIS_STEPS)
    gain = in_focus.loss - best.loss
    if gain <= 0.0:
        return 0.0
    is_worthy = 2.0 * gain > least_gain * best.excess**_EXCESS_POWER
    return (begin + steps) * _KURTOSIS_STEP if is_worthy else 0.0


def _with_kurtosis(fit: DiscFit, kurtosis: float) -> DiscFit:
    """Return a fit whose pixels have a point spread with this kurtosis."""
    pixels = replace(fit.sample.pixels, kurtosis=kurtosis)
    return replace(fit, sample=replace(fit.sample, pixels=pixels))


def _joints(fits: Sequence[DiscFit], tones: Sequence[Tone]) -> list[JointFit]:
    """Return discs adjusted together with each of some curves, without those that fail."""
    return [joint for joint in (_from_first_fits(fits, tone) for tone in tones) if joint]


def _likeliest(joints: Sequence[JointFit]) -> JointFit | None:
    """Return the likeliest; None if there is none."""
    return min(joints, key=lambda joint: joint.loss, default=None)


def _worth_comparing(plain: Sequence[JointFit], bent: Sequence[JointFit]) -> list[JointFit]:
    """Return the joint fits that are worth a comparison by their own masks.

    Without a significant gain by bending, that is the likeliest plain curve alone. Where discs
    contradict each other more than their noise explains, the model lacks something that the bends
    may stand for: the gain must be larger there.

    Otherwise they are the bent curves that are nearly as likely as the best. But if the line is the
    likelier plain curve, it is the bent line alone, unless bent sRGB is much likelier: sRGB's curve
    bent nearly straight keeps a bend at its dark end, which makes discs too large or too small.
    """
    unbent, best = _likeliest(plain), _likeliest(bent)
    if unbent is None or best is None:
        return [joint for joint in (best or unbent,) if joint]
    gain = unbent.loss - best.loss
    if 2.0 * gain <= _SIGNIFICANT_BENDS * best.excess**_EXCESS_POWER:
        return [unbent]
    line = next((joint for joint in bent if joint.tone is Tone.UNKNOWN_OVER_LINE), None)
    if unbent.tone is Tone.LINEAR and line is not None:
        farther = max(joint.loss for joint in plain) - unbent.loss
        if line.loss - best.loss <= _LINE_PREFERENCE * farther:
            return [line]
    return [joint for joint in bent if joint.loss - best.loss < _NEARLY_AS_LIKELY * gain]


def _are_burnt(fits: Sequence[DiscFit]) -> bool:
    """Return whether a level of most discs is clipped."""
    return float(np.mean([fit.sample.is_burnt for fit in fits])) > 0.5


def _slightly_bent(prior: ProcessingPrior) -> ProcessingPrior:
    """Return what is known of the camera, with bends free by a small standard deviation."""
    precision = prior.precision.copy()
    waves = np.arange(WAVES)
    precision[waves, waves] = _LITTLE_BENT**-2
    return ProcessingPrior(prior.mean, precision)


def _from_first_fits(fits: Sequence[DiscFit], tone: Tone) -> JointFit | None:
    """Adjust discs together, from their first fits; None if that fails."""
    if not fits:
        return None
    sharpening = float(np.median([fit.state.vector[Row.SHARPENING] for fit in fits]))
    states = [_state_by(fit, tone, sharpening) for fit in fits]
    sharpening_px, sds = fits[0].free.sharpening_px, [fit.sd for fit in fits]
    return _adjusted_together(fits, states, tone, sharpening_px, sds=sds)


def _adjusted_together(
    fits: Sequence[DiscFit],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
    *,
    sds: Sequence[FloatArray],
) -> JointFit | None:
    samples = _samples_by(fits, states, tone, sharpening_px)
    try:
        return adjust_together(samples, states, tone, sharpening_px, sds)
    except (NoFit, np.linalg.LinAlgError):
        return None


def _adjusted_before_compression(
    fits: Sequence[DiscFit],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
    *,
    steps: Sequence[FloatArray | None],
    sds: Sequence[FloatArray] | None = None,
) -> JointFit | None:
    samples = _samples_by(fits, states, tone, sharpening_px)
    try:
        return adjust_before_compression(samples, states, tone, sharpening_px, steps, sds)
    except (NoFit, np.linalg.LinAlgError):
        return None


def _samples_by(
    fits: Sequence[DiscFit], states: Sequence[DiscState], tone: Tone, sharpening_px: float
) -> list[DiscSample]:
    return [
        fit.sample.by(tone, sharpening_px, state) for fit, state in zip(fits, states, strict=True)
    ]


def _with_best_mask(joint: JointFit, adjusted: Callable[..., JointFit | None]) -> JointFit:
    """Return discs adjusted with the mask that makes them likeliest.

    Parameters
    ----------
    adjusted : callable
        Adjusts discs, given fits, states, a curve and the σ of a mask; None if that fails.
    """
    sharpening = CAMERA_ROWS.index(Row.SHARPENING)
    sd = float(np.sqrt(np.linalg.inv(joint.precision)[sharpening, sharpening]))
    if abs(joint.shared[sharpening]) < max(_LEAST_SHARPENING, _SIGNIFICANT * sd):
        return joint

    def at(step: float) -> JointFit | None:
        states = [fit.state for fit in joint.fits]
        return adjusted(joint.fits, states, joint.tone, _MASK_STEP**step * SHARPENING_PX)

    # anew also for step 0, since the mask uses the states for the pixels that are not adjusted
    _, best = likeliest_along(at, at(0) or joint, _MOST_STEPS)
    return best


def _before_compression(bent: JointFit, steps: Sequence[FloatArray | None]) -> JointFit | None:
    """Adjust discs anew to what JPEG left of their coefficients; None if that fails.

    Parameters
    ----------
    bent : JointFit
        Discs with the likeliest plain curve, bent, and a mask of the usual width.
    steps : sequence of (8, 8) arrays
        Of each disc's photograph; None: not compressed.
    """
    adjusted = partial(_adjusted_before_compression, steps=steps)
    states = [fit.state for fit in bent.fits]
    first = adjusted(bent.fits, states, bent.tone, bent.sharpening_px)
    if first is None:
        return None
    again = partial(adjusted, sds=[fit.sd for fit in first.fits])
    states = [fit.state for fit in first.fits]
    likelier = _from_both_starts(again, first.fits, states, bent.tone, bent.sharpening_px) or first
    return replace(_with_best_mask(likelier, again), is_settled=first.is_settled)


def _from_both_starts(
    adjusted: Callable[..., JointFit | None],
    fits: Sequence[DiscFit],
    states: Sequence[DiscState],
    tone: Tone,
    sharpening_px: float,
) -> JointFit | None:
    """Return discs adjusted from states, or from the same with more contrast if that is likelier.

    Parameters
    ----------
    adjusted : callable
        Adjusts discs, given fits, states, a curve and the σ of a mask; None if that fails.
    """
    contrasting = [_with_waves(state, tone, _MORE_CONTRAST) for state in states]
    both = [adjusted(fits, each, tone, sharpening_px) for each in (states, contrasting)]
    return _likeliest([joint for joint in both if joint])


def _with_waves(state: DiscState, tone: Tone, waves: FloatArray) -> DiscState:
    """Return the state with other amplitudes (3,) of the curve, but the same grey values."""
    vector, levels = state.vector.copy(), [Row.BLACK, Row.WHITE]
    vector[Row.WAVE_1 : Row.SHARPENING] = waves
    vector[levels] = DiscState(vector).tone(tone).light(np.array(state.plateaus(tone)))
    return DiscState(vector)


def _is_bent(joint: JointFit) -> bool:
    """Tell whether the bends of a curve are significant.

    They must differ from those of a curve that counts as not bent, and more so where discs
    contradict each other. The limit grows with the square of that excess here. With film's curve in
    JPEGs of quality 92, the excess is 1.3 to 2.1; with its third power, a quarter of the
    photographs of dark discs of R 5 px seemed to be sRGB's, and centres were off by 0.012 px where
    light falls off by 5 % over the radius. With its square they are off by 0.007 px.
    """
    waves, excess = joint.shared[:WAVES], joint.excess
    cov = excess * np.linalg.inv(joint.precision)[:WAVES, :WAVES] + _LITTLE_BENT**2 * np.eye(WAVES)
    square = excess * float(waves @ np.linalg.solve(cov, waves))
    return square > _SIGNIFICANT_BENDS * excess * excess


def _state_by(fit: DiscFit, tone: Tone, sharpening: float) -> DiscState:
    """Return the state of a first fit for another tone curve, with the same grey levels."""
    vector = fit.state.vector.copy()
    vector[Row.SHARPENING] = sharpening
    if not tone.is_srgb:
        vector[[Row.BLACK, Row.WHITE]] = fit.state.plateaus(fit.free.tone)
    return DiscState(vector)
