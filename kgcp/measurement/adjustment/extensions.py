"""Extensions of the plain model: levels that vary, and point spreads that are no Gaussians.

The plain model is fitted first. If its residuals need no extension, its result stands.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.measurement.adjustment.acceptance import check_code
from kgcp.measurement.adjustment.appearance import TONE_OF_BASE
from kgcp.measurement.adjustment.covariance import pose_covariance
from kgcp.measurement.adjustment.likelihood import advantage_on_own_pixels, advantage_over
from kgcp.measurement.adjustment.normal_equations import Unknowns
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.plateaus import (
    Plateaus,
    as_if_burnt,
    evened_window,
    field_of,
    is_white_without_noise,
    look_at_plateaus,
    shadows_across,
)
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.random_levels import (
    chi2_with_levels,
    even_field,
    fit_levels,
    fit_other_pose,
    needs_varying_levels,
)
from kgcp.measurement.adjustment.solver import TargetFit, adjust, moved_to
from kgcp.measurement.adjustment.spread_shape import (
    KURTOSIS_CHI2_WITH_LEVELS,
    shape_needed,
    with_shape,
)
from kgcp.measurement.adjustment.two_poses import TwoPoses, fit_at, fit_both_poses
from kgcp.measurement.adjustment.unknowns import (
    EDGE_TONE_CHI2,
    unknowns_of,
    with_edge_tone,
    without_even_light,
)
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.photometry import (
    PARAM_COUNT,
    Light,
    Param,
    Tone,
    decoded,
    light_over_base,
)
from kgcp.measurement.image_model.shadow_edges import INK
from kgcp.measurement.image_model.shadow_search import FoundShadows
from kgcp.measurement.records import ToneBase

_NUDGE = 1e-6  # start value of skew and kurtosis: at 0, their derivatives would be left out
# Residuals that agree along edges inflate the covariance. Where levels vary, a larger inflation
# than this says that the fit has probably ended beside its minimum. In 58 simulated frames with
# dirt, the five fits that had done so had inflations of 3.9 to 5.7, nearly all others less than 3.
_OFF_MINIMUM_INFLATION = 3.0
# Where levels vary, an unknown curve is implausible if its three shapes have a larger χ² than this
# against their priors. Of 64 simulated rings of R 150 to 290 px in uneven light, half have 5 or
# less. Four have 30 or more; three of these were off by 2.5, 4.8 and 8.7 σ.
_IMPLAUSIBLE_CHI2 = 30.0
_CURVE = [Param.TONE_1, Param.TONE_2, Param.TONE_3]
# Gain in log-likelihood that levels that vary must bring on a small ring. Coarse prints and coarse
# renderers make residuals agree along edges, too. In even light, levels that vary fitted five rings
# better: four gained 9 to 19, and their errors grew from 0.04 to 0.06 %. In uneven light, six of
# 200 fits gained less than 25; fitted with even light, none of the six was off by more than 2.3 σ.
_LEAST_ADVANTAGE_IN_SMALL_RING = 25.0
# If a larger share of a fit's pixels is clipped, edges show too little to tell a tone of their own
# from the tone curve. With that tone free, 40 burnt plates half in shade had z of 2.0 and 1.7 by
# two simulated phones; without it, 1.6 and 1.4.
_MOST_CLIPPED_FOR_EDGE_TONE = 0.02
# Largest blur, in bins, with which an edge is within a bin, so that a tone curve only displaces it.
# Of random rings of R 150 to 360 px, 22 with a larger one had distances that were off by 27 ppm (in
# the median, z 2.0), and by single pixels 5 ppm (0.7).
_SHARP_IN_BINS = 0.65
# White whose noise does not tell whether it is burnt may be so from this share of the range on. It
# is if even light explains the image with clipped white, with a log-likelihood that is greater by
# so much than with the white that is seen. Of 72 burnt rings of simulated phones (R 20 to 76 px)
# that even light explains then, 71 gain 57 or more over one of the bases; their white is at 0.93 to
# 0.98 of the range. Of 198 rings that are not burnt, eight were taken for burnt with these limits.
# Without that of white it would be 42, and errors of some sets grew by up to a third, since pixels
# near white are then left out.
_LEAST_BURNT, _LEAST_ADVANTAGE_OF_BURNT = 0.92, 40.0
_MOST_BURNT = 3.0  # largest start value of a burnt white, relative to the clipped one that is seen


class BinsAreTooCoarse(Exception):  # noqa: N818 - the outcome of one fit
    """Bins do not show all that matters: smaller bins are to be adjusted, or single pixels."""


class WhiteIsBurnt(Exception):  # noqa: N818 - the outcome of one fit
    """White is burnt below the end of the range; `problem` takes it for clipped."""

    def __init__(self, problem: FitProblem) -> None:
        super().__init__()
        self.problem = problem


@dataclass(frozen=True, slots=True, eq=False)
class FitsByTone:
    """The fits of one target over the bases that an unknown tone curve may have."""

    likelier: TwoPoses
    # the fit over the other base; None: it failed or was not tried, or the tone is known
    rival: TwoPoses | None
    advantage: float = 0.0  # of the likelier one, in log-likelihood
    untried_base: ToneBase | None = None  # None: both were tried, or the tone is known


def fit_in_any_light(
    problem: FitProblem, pose: Pose, blur: Blur, base: ToneBase | None = None
) -> FitsByTone:
    """Adjust both poses in even or uneven light, an unknown tone over both of its bases.

    The bases are sRGB's curve and a straight line. The three shapes of a fitted curve describe
    curves near either of them. If white turns out to be burnt, it is taken for clipped, and both
    fits are made anew.

    Parameters
    ----------
    base : ToneBase, optional
        The base that other frames agree on. The other one is tried only if the fit over this one
        fails, or seems to have ended beside its minimum.

    Raises
    ------
    Rejection
        As `_fit_in_any_light`, if the fits over both fail.
    BinsAreTooCoarse
        Only if the problem `may_be_finer`.
    """
    try:
        return _fit_over_bases(problem, pose, blur, base)
    except WhiteIsBurnt as burnt:
        return _fit_over_bases(replace(burnt.problem, tone=problem.tone), pose, blur, base)


def _fit_over_bases(
    problem: FitProblem, pose: Pose, blur: Blur, base: ToneBase | None
) -> FitsByTone:
    """Do what `fit_in_any_light` does.

    Raises
    ------
    WhiteIsBurnt
        If white is, and is not yet taken for clipped.
    """
    # plateaus are the same for both bases: they are found once
    find_plateaus = cache(partial(look_at_plateaus, problem, pose, blur.mean_sd_px))
    if problem.tone is not Tone.UNKNOWN:
        return FitsByTone(_fit_in_any_light(problem, pose, blur, find_plateaus), None)
    fits: dict[ToneBase, TwoPoses] = {}
    failures: dict[ToneBase, tuple[Reason, str]] = {}
    for each in sorted(ToneBase, key=lambda each: each is not base):  # the given one first
        if base in fits and _is_at_minimum(fits[base].best):
            return FitsByTone(fits[base], None, untried_base=each)
        toned = replace(problem, tone=TONE_OF_BASE[each])
        start = next((poses for poses in fits.values() if _is_at_minimum(poses.best)), None)
        try:
            fits[each] = _fit_in_any_light(toned, pose, blur, find_plateaus, start)
        except Rejection as rejection:
            failures[each] = rejection.reason, rejection.detail
    if not fits:
        raise Rejection(*failures[ToneBase.LINE])  # the same one, whichever was tried first
    return _by_likelihood(fits)


def with_untried_base(fits: FitsByTone, pose: Pose, blur: Blur) -> FitsByTone:
    """Fit over the base that was not tried, too; if that fails, the first fit stays alone."""
    if fits.untried_base is None:
        return fits
    tried = fits.likelier.best.sample.problem  # without burnt white
    toned = replace(tried, tone=TONE_OF_BASE[fits.untried_base])
    find_plateaus = partial(look_at_plateaus, toned, pose, blur.mean_sd_px)
    try:
        other = _fit_in_any_light(toned, pose, blur, find_plateaus)
    except Rejection:
        return replace(fits, untried_base=None)
    except WhiteIsBurnt as burnt:
        return fit_in_any_light(replace(burnt.problem, tone=Tone.UNKNOWN), pose, blur)
    (first,) = set(ToneBase) - {fits.untried_base}
    return _by_likelihood({first: fits.likelier, fits.untried_base: other})


def _by_likelihood(fits: Mapping[ToneBase, TwoPoses]) -> FitsByTone:
    """Return the fits over one base or both, the likelier one first.

    If only one fit has a plausible curve, and its residuals agree less along edges, the other fit
    counts as failed.
    """
    if len(fits) == 1:
        (alone,) = fits.values()
        return FitsByTone(alone, None)
    plausible = [poses for poses in fits.values() if _is_curve_plausible(poses.best)]
    if len(plausible) == 1:
        (kept,) = plausible
        (other,) = (poses for poses in fits.values() if poses is not kept)
        if _inflation(kept.best) < _inflation(other.best):
            return FitsByTone(kept, None)
    over_srgb, over_line = fits[ToneBase.SRGB], fits[ToneBase.LINE]
    advantage = advantage_over(over_srgb.best, over_line.best)
    if advantage > 0.0:
        return FitsByTone(over_line, over_srgb, advantage)
    return FitsByTone(over_srgb, over_line, -advantage)


def _is_at_minimum(fit: TargetFit) -> bool:
    """Tell whether nothing suggests that a fit has ended beside its minimum."""
    if fit.level_equations is None:
        return True
    return _is_curve_plausible(fit) and _inflation(fit) < _OFF_MINIMUM_INFLATION


def _inflation(fit: TargetFit) -> float:
    """Return by how much residuals inflate the covariance; infinite if that is undefined."""
    try:
        return pose_covariance(fit).inflation
    except Rejection:
        return math.inf


def _is_curve_plausible(fit: TargetFit) -> bool:
    """Tell whether a tone curve is one that a camera may have; always true in even light."""
    if fit.level_equations is None:
        return True
    shapes = fit.parameters.vector[_CURVE]
    return float(fit.unknowns.precision[_CURVE] @ (shapes * shapes)) < _IMPLAUSIBLE_CHI2


def _fit_in_any_light(
    problem: FitProblem,
    pose: Pose,
    blur: Blur,
    find_plateaus: Callable[[], Plateaus | None],
    over_other_base: TwoPoses | None = None,
) -> TwoPoses:
    """Adjust both poses by the plain model, and with the extensions that its residuals need.

    Parameters
    ----------
    over_other_base : TwoPoses, optional
        The fit of the same target over the other base of the tone curve, at its minimum. If its
        levels vary, it is the best start.

    Raises
    ------
    Rejection
        As `kgcp.measurement.adjustment.two_poses.fit_both_poses`; `OTHER_CODE` if the code is not
        seen where the levels are even; `POOR_FIT` if varying levels do not explain the image
        either.
    WhiteIsBurnt
        If white is not yet taken for clipped.
    BinsAreTooCoarse
        Only if the problem `may_be_finer`.
    """
    levels_vary = over_other_base is not None and over_other_base.best.level_equations is not None
    start = over_other_base if levels_vary else None
    poses = _best_in_any_light(problem, pose, blur, find_plateaus, start)
    if poses.best.level_equations is None:
        return poses
    return TwoPoses(*fit_other_pose(poses.best, poses.other.parameters.pose))


def _best_in_any_light(
    problem: FitProblem,
    pose: Pose,
    blur: Blur,
    find_plateaus: Callable[[], Plateaus | None],
    start: TwoPoses | None,
) -> TwoPoses:
    """Do what `_fit_in_any_light` does; where levels vary, the other pose is not adjusted.

    `start` is a fit with levels that vary, over the other base of the tone curve.
    """
    if start is not None:
        plateaus = find_plateaus()
        if plateaus is not None and plateaus.is_uneven:
            varying = _with_edge_tone(problem, _fit_over_other_base(problem, start))
            return _with_kurtosis(problem, varying)
    try:
        plain = _fit_in_even_light(problem, pose, blur)
    except Rejection:
        plateaus = find_plateaus()
        _raise_if_burnt(problem, pose, blur, plateaus, None)
        if plateaus is None or not plateaus.is_uneven:
            raise
        if problem.may_be_finer:
            raise BinsAreTooCoarse from None
        return _fit_from_plateaus(problem, pose, blur, plateaus)
    if not needs_varying_levels(plain.best):
        return plain
    if problem.may_be_finer:
        raise BinsAreTooCoarse
    plateaus = find_plateaus()
    _raise_if_burnt(problem, pose, blur, plateaus, plain.best)
    if start is not None:
        varying = _with_edge_tone(problem, _fit_over_other_base(problem, start))
    elif plateaus is None or not plateaus.is_uneven:
        # the one tone parameter of bins holds only for the levels that it was fitted with
        seen = None if problem.tone is Tone.BINNED else plateaus
        varying = _with_edge_tone(problem, _with_varying_levels(problem, plain, seen))
    else:
        varying = _fit_from_plateaus(problem, pose, blur, plateaus)
    return plain if _may_be_even(plain.best, varying.best) else varying


def _fit_in_even_light(problem: FitProblem, pose: Pose, blur: Blur) -> TwoPoses:
    """Adjust both poses by the plain model, with the shape of the point spread that it needs.

    Raises
    ------
    BinsAreTooCoarse
        Only if the problem `may_be_finer`: bins show the profile of edges, for which one tone
        parameter is not enough.
    """
    poses = fit_both_poses(problem, pose, blur)
    if problem.may_be_finer and (
        poses.best.parameters.blur.largest_sd_px > _SHARP_IN_BINS or shape_needed(poses.best)
    ):
        raise BinsAreTooCoarse
    return _with_shape(problem, poses)


def _raise_if_burnt(
    problem: FitProblem,
    pose: Pose,
    blur: Blur,
    plateaus: Plateaus | None,
    plain: TargetFit | None,
) -> None:
    """Raise `WhiteIsBurnt` if white is, and is not yet taken for clipped.

    Burnt white has no noise. What JPEG leaves beside edges hides that on small rings. There, white
    is burnt if even light explains the image as soon as white is taken for clipped.

    Parameters
    ----------
    plain : TargetFit or None
        The fit in even light that does not explain the image; None: it failed.
    """
    if plateaus is None or problem.burnt_white is not None:
        return
    burnt = as_if_burnt(problem, plateaus)
    if burnt is None:
        return
    if is_white_without_noise(problem, plateaus):
        raise WhiteIsBurnt(burnt)
    if burnt.brightest < _LEAST_BURNT * problem.censoring.high:
        return
    try:
        fit = _fit_in_even_light(burnt, pose, blur).best
    except Rejection:
        return
    if needs_varying_levels(fit):
        return
    if plain is None or advantage_on_own_pixels(fit, plain) > _LEAST_ADVANTAGE_OF_BURNT:
        raise WhiteIsBurnt(burnt)


def _may_be_even(plain: TargetFit, varying: TargetFit) -> bool:
    """Tell whether levels that vary gain so little on a small ring that the light may be even.

    If they lose, their fit has ended beside its minimum and says nothing.
    """
    if not plain.sample.problem.is_ring_small:
        return False
    return 0.0 <= advantage_over(plain, varying) < _LEAST_ADVANTAGE_IN_SMALL_RING


def _fit_from_plateaus(problem: FitProblem, pose: Pose, blur: Blur, plateaus: Plateaus) -> TwoPoses:
    """Adjust both poses with levels that vary, from a start that the plateaus show."""
    poses = fit_both_poses(evened_window(problem, plateaus), pose, blur)
    varying = _with_shape(problem, _with_varying_levels(problem, poses, plateaus))
    return _with_kurtosis(problem, _with_edge_tone(problem, varying))


def _fit_over_other_base(problem: FitProblem, poses: TwoPoses) -> TwoPoses:
    """Adjust a fit with levels that vary over another base of the tone curve.

    The start takes over its levels: they are light before the curve, and do not depend on the base.
    The worse pose is not adjusted.
    """
    first = poses.best.parameters
    light = light_over_base(first.light, poses.best.sample.problem.tone, problem.tone)
    start = replace(Parameters.of(first.pose, first.blur, light), field=first.field)
    best = fit_levels(problem, [start], poses.best.unknowns)
    return TwoPoses(best, moved_to(best, poses.other.parameters.pose))


def _with_shape(problem: FitProblem, poses: TwoPoses) -> TwoPoses:
    """Make skew and kurtosis of the point spread free, if the residuals need it."""
    best, other = poses.best, poses.other
    shape = shape_needed(best)
    if not shape:
        return poses
    spreads = [(best.parameters, best.unknowns)]
    blur = best.parameters.blur
    if blur.has_streak:  # a lens's elongated spread may have been taken for motion
        gaussian = Parameters.of(
            best.parameters.pose, Blur(*blur.total_covariance), best.parameters.light
        )
        gaussian = replace(gaussian, field=best.parameters.field)
        unknowns = unknowns_of(problem, has_streak=False)
        is_even = gaussian.field is None
        spreads.append((gaussian, unknowns if is_even else without_even_light(unknowns)))
    shaped = []
    for parameters, unknowns in spreads:
        with contextlib.suppress(Rejection):  # then the plain model is the better one
            shaped.append(
                _fit_shaped(problem, parameters, other.parameters.pose, with_shape(unknowns, shape))
            )
    if not shaped:
        return poses
    likelier = shaped[0]
    for each in shaped[1:]:
        if advantage_over(likelier.best, each.best) > 0.0:
            likelier = each
    return likelier


def _with_edge_tone(problem: FitProblem, poses: TwoPoses) -> TwoPoses:
    """Give edges a tone of their own beside levels that vary, if residuals need it.

    That may reveal a kurtosis that levels and tone curve hid. Burnt plates show only a part of each
    edge, too little for two curves: they are left as they are.
    """
    best = poses.best
    if best.level_equations is None or not problem.tone.is_unknown or best.parameters.has_edge_tone:
        return poses
    if np.mean(best.sample.censoring.is_clipped) > _MOST_CLIPPED_FOR_EDGE_TONE:
        return poses
    unknowns = with_edge_tone(best.unknowns)
    toned = _with_parameter_if_needed(problem, poses, unknowns, Param.EDGE_TONE, EDGE_TONE_CHI2)
    return poses if toned is poses else _with_kurtosis(problem, toned)


def _with_kurtosis(problem: FitProblem, poses: TwoPoses) -> TwoPoses:
    """Make the kurtosis of the point spread free beside levels that vary, if residuals need it."""
    best = poses.best
    if best.level_equations is None or best.parameters.has_kurtosis:
        return poses
    unknowns = with_shape(best.unknowns, [int(Param.KURTOSIS)])
    return _with_parameter_if_needed(
        problem, poses, unknowns, Param.KURTOSIS, KURTOSIS_CHI2_WITH_LEVELS
    )


def _with_parameter_if_needed(
    problem: FitProblem, poses: TwoPoses, unknowns: Unknowns, param: Param, least_chi2: float
) -> TwoPoses:
    """Fit with one more parameter if its score test exceeds a χ²."""
    with contextlib.suppress(Rejection):  # then it is better without
        if chi2_with_levels(poses.best, unknowns, param) > least_chi2:
            return _fit_shaped(
                problem, poses.best.parameters, poses.other.parameters.pose, unknowns
            )
    return poses


def _fit_shaped(
    problem: FitProblem, start: Parameters, other: Pose, unknowns: Unknowns
) -> TwoPoses:
    nudge = np.zeros(PARAM_COUNT)
    nudge[unknowns.free[unknowns.free >= Param.SKEW_XXX]] = _NUDGE
    nudged = replace(start, vector=start.vector + nudge)
    if nudged.field is not None:
        best = fit_levels(problem, [nudged], unknowns)
        return TwoPoses(best, moved_to(best, other))
    shaped = adjust(problem, nudged, unknowns)
    return TwoPoses(shaped, fit_at(shaped, other))


def _with_varying_levels(
    problem: FitProblem, poses: TwoPoses, plateaus: Plateaus | None
) -> TwoPoses:
    """Adjust with levels that vary, started from those seen on ink and plate.

    Starts with the edge of a shadow are tried first. Without plateaus the start is even light.

    No tone curve is taken over. That of an evened image is another one, and that of a plain fit to
    a burnt image has a white that is far too bright.
    """
    first = poses.best.parameters
    if plateaus is None:
        # without the parameters that levels that vary replace
        light = replace(first.light, slope_x=0.0, slope_y=0.0, curvature=0.0, linear_sharpening=0.0)
        return _fit_varying_levels(problem, poses, [Parameters.of(first.pose, first.blur, light)])
    plateaus = look_at_plateaus(problem, first.pose, first.blur.mean_sd_px) or plateaus
    black, white = decoded(np.array(plateaus.extremes), problem.tone).tolist()
    light = Light(black, white)
    field = field_of(even_field(problem), problem, plateaus, light)
    smooth = replace(Parameters.of(first.pose, first.blur, light), field=field)
    shadows = reversed(shadows_across(problem, plateaus))
    edged = [_under_shadows(problem, first, seen) for seen in shadows]
    return _fit_varying_levels(problem, poses, [*edged, smooth])


def _under_shadows(problem: FitProblem, first: Parameters, seen: FoundShadows) -> Parameters:
    """Return the start with straight edges of shadows across the plate."""
    rows = seen.edges.rows.copy()
    # the second edge of a strip of shadow adds back what the first one takes
    falls = rows[:, INK:].sum(axis=1, keepdims=True) < 0.0
    steps = np.where(falls, rows[:, INK:], -rows[:, INK:])
    beyond = decoded(np.maximum(seen.sunlit_levels + steps, 0.0), problem.tone)
    ink, plate = decoded(np.maximum(seen.sunlit_levels, 0.0), problem.tone).tolist()
    # if the curve is unknown, the white that is seen sets the scale
    if seen.is_burnt(problem.censoring.high) and not problem.tone.is_unknown:
        plate = _burnt_white(ink, plate, beyond)
    steps = (beyond - (ink, plate)) / (plate - ink)
    rows[:, INK:] = np.where(falls, steps, -steps)
    field = replace(even_field(problem), shadows=replace(seen.edges, rows=rows))
    light = Light(ink, plate)
    return replace(Parameters.of(first.pose, first.blur, light), field=field)


def _burnt_white(ink: float, plate: float, beyond: FloatArray) -> float:
    """Estimate the plate's level in full light, where it is clipped.

    Shade reduces ink and plate by the same factor. The factor is seen on ink, and the plate is seen
    in the shade. `beyond` (s, 2) are the levels of ink and plate there.
    """
    if ink <= 0.0:
        return plate
    left = np.clip(beyond[:, 0] / ink, 1.0 / _MOST_BURNT, 1.0)
    return float(np.clip(np.max(beyond[:, 1] / left), plate, _MOST_BURNT * plate))


def _fit_varying_levels(problem: FitProblem, poses: TwoPoses, starts: list[Parameters]) -> TwoPoses:
    """Fit with levels that vary; these may hide a dot, so the code is checked with even ones."""
    check_code(poses.best)
    best = fit_levels(problem, starts, without_even_light(poses.best.unknowns))
    return TwoPoses(best, moved_to(best, poses.other.parameters.pose))
