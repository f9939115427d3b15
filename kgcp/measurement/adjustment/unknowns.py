"""Which parameters are estimated: light by the response, blur as a Gaussian or as a streak."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from kgcp.measurement.adjustment.normal_equations import Unknowns
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.adjustment.problem import FitProblem
from kgcp.measurement.adjustment.solver import TargetFit, adjust
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.photometry import PARAM_COUNT, Param, Tone

_MANY_PIXELS_RADIUS_PX = 40.0  # larger rings are first fitted on few pixels, which saves time
_SHORTEST_STREAK_PX = 2.0  # below, a streak looks like a Gaussian
# A Gaussian that is fitted to the edges of a streak makes it too long, by up to the first share;
# the formula is in `_streak_of`.
_TOO_LONG, _TOO_LONG_FROM2 = 0.095, 15.0

_PRIOR_SD = {
    Param.BLUR_DIFFERENCE: 0.5,
    Param.BLUR_XY: 0.5,
    Param.SLOPE_X: 0.05,
    Param.SLOPE_Y: 0.05,
    Param.CURVATURE: 0.03,
    Param.TONE_1: 0.7,
    Param.TONE_2: 0.5,
    Param.TONE_3: 0.5,
    Param.SHARPENING: 0.7,
    Param.LINEAR_SHARPENING: 0.3,
}
_STATED_TONE_SD = 0.02  # of the three shapes of a stated curve; 0.06 and 0.2 are no better
EDGE_TONE_CHI2 = 100.0
"""χ² above which edges have a tone of their own beside levels that vary.

In 29 rings under another program's shadows and in its dirt, the fit over the base with the smaller
χ² has at most 20. Of 24 rings in dirt behind a bilateral filter (R ≥ 37 px), 41 of the 48 fits over
both bases have 200 and more. A wrong base of the curve raises the χ², too, but by less.
"""
_EDGE_TONE_SD = 0.15  # with 0.5, errors under highlights are twice as large
# Prior of the white if the tone is free: without it, the two drift together on burnt plates.
_WHITE, _WHITE_SD = 1.0, 0.4
_ALWAYS = [*range(6), Param.BLUR_MEAN, Param.BLACK, Param.WHITE, Param.SLOPE_X, Param.SLOPE_Y]
_GAUSSIAN = [Param.BLUR_DIFFERENCE, Param.BLUR_XY]
_STREAK = [Param.STREAK_X, Param.STREAK_Y]
_TONE = [Param.TONE_1, Param.TONE_2, Param.TONE_3]
_SHAPED = [Param.CURVATURE, *_TONE, Param.SHARPENING]
_GRADIENT = [Param.SLOPE_X, Param.SLOPE_Y, Param.CURVATURE]
# What levels that vary replace.
_EVEN_LIGHT = [Param.BLACK, Param.WHITE, *_GRADIENT, Param.LINEAR_SHARPENING]
_OF_TONE = {
    Tone.LINEAR: [],
    Tone.SRGB: [Param.SHARPENING],
    Tone.NEAR_SRGB: [*_TONE, Param.SHARPENING],
    Tone.UNKNOWN: [*_SHAPED, Param.LINEAR_SHARPENING],
    Tone.UNKNOWN_OVER_LINE: _SHAPED,
    Tone.BINNED: [Param.TONE_1],  # takes how far a tone curve displaces edges within bins
}


def adjust_with_streak(
    problem: FitProblem, start: Parameters, *, moves_pose: bool = True
) -> TargetFit:
    """Adjust with a Gaussian blur, or with a streak; with `moves_pose`, adjust the pose, too."""
    streak = _streak_of(start.blur)
    if streak is None:
        best = adjust(problem, start, unknowns_of(problem, has_streak=False, moves_pose=moves_pose))
        streak, start = _streak_of(best.parameters.blur), best.parameters
        if streak is None:
            return best
    unknowns = unknowns_of(problem, has_streak=True, moves_pose=moves_pose)
    streaked = Parameters.of(start.pose, streak, start.light)
    is_large = problem.outer_radius_px > _MANY_PIXELS_RADIUS_PX
    near = adjust(problem, streaked, unknowns, problem.few_pixels if is_large else None)
    return adjust(problem, near.parameters, unknowns) if near.sample.is_thinned else near


def unknowns_of(problem: FitProblem, *, has_streak: bool, moves_pose: bool = True) -> Unknowns:
    """Return which parameters are free, with weak priors on those that one frame hardly tells."""
    return _unknowns(problem.tone, has_streak=has_streak, moves_pose=moves_pose)


@cache
def _unknowns(tone: Tone, *, has_streak: bool, moves_pose: bool) -> Unknowns:
    free = [*_ALWAYS, *(_STREAK if has_streak else _GAUSSIAN), *_OF_TONE[tone]]
    mean, precision = np.zeros(PARAM_COUNT), np.zeros(PARAM_COUNT)
    for param, sd in _PRIOR_SD.items():
        precision[param] = sd**-2 if param in free else 0.0
    if tone is Tone.NEAR_SRGB:
        precision[_TONE] = _STATED_TONE_SD**-2
    elif tone.is_shaped:
        mean[Param.WHITE], precision[Param.WHITE] = _WHITE, _WHITE_SD**-2
    estimated = np.array(sorted(free)[0 if moves_pose else 6 :])
    return Unknowns(estimated, mean, precision, precision[estimated])


def without_even_light(unknowns: Unknowns) -> Unknowns:
    """Return the unknowns of a fit whose levels vary.

    The levels replace gradient and curvature of the light, and their offsets replace black and
    white. These two are fixed, as the scale of the levels and of the tone curve. If white were
    free, it could stretch that scale while the levels shrink, and the image would hardly change:
    steps fail along such a curved valley, and fits stay where they start.

    Two sharpenings beside the levels are too many: with a highlight on a ring of R 107 px, their
    strengths came out as 0.85 and −0.74, and the distance was off by 4.6 σ. Only the one after the
    tone curve stays.
    """
    free = unknowns.free[~np.isin(unknowns.free, _EVEN_LIGHT)]
    return replace(unknowns, free=free, free_precision=unknowns.precision[free])


def with_pose(unknowns: Unknowns) -> Unknowns:
    """Return the unknowns of a fit with a fixed pose, with the pose added."""
    free = np.append(np.arange(6), unknowns.free)
    return replace(unknowns, free=free, free_precision=unknowns.precision[free])


def with_edge_tone(unknowns: Unknowns) -> Unknowns:
    """Return the unknowns of a fit whose levels vary, with the tone of edges added."""
    free, precision = np.append(unknowns.free, int(Param.EDGE_TONE)), unknowns.precision.copy()
    precision[Param.EDGE_TONE] = _EDGE_TONE_SD**-2
    return Unknowns(free, unknowns.mean, precision, precision[free])


def _streak_of(blur: Blur) -> Blur | None:
    """Return the streak of uniform motion that an elongated Gaussian stands for, if it is long.

    A Gaussian fitted to the edges by least squares makes the streak too long: by up to a tenth of
    its length, the more so the longer it is against the blur across it.

    Returns
    -------
    Blur or None
        None if the streak is too short to be told from a Gaussian.
    """
    difference, mean = 0.5 * (blur.xx - blur.yy), 0.5 * (blur.xx + blur.yy)
    half_range = math.hypot(difference, blur.xy)
    length = math.sqrt(24.0 * half_range)
    if length < _SHORTEST_STREAK_PX:
        return None
    direction = 0.5 * math.atan2(blur.xy, difference)
    across = mean - half_range
    length *= 1.0 - _TOO_LONG * length**2 / (length**2 + _TOO_LONG_FROM2 * across)
    return Blur(across, across, 0.0, length * math.cos(direction), length * math.sin(direction))
