"""Photographs that stand apart: with another zoom, focus or crop, or of a field bent otherwise.

A single one of them falsifies the camera. Rejecting discs one by one does not reveal it: its pose
absorbs most of the error, and the rest is spread over all photographs. It is recognised because the
others fit well without it.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.network.calibration_records import comparable_residuals, misfit_px, operator_sd_px
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem

# A misfit below this multiple of the stated standard deviation of the discs leaves nothing to
# explain: all photographs fit.
_FITTING_RATIO = 1.5
# At most this share of the photographs may stand apart, and at least this many must remain.
_MAX_SHARE = 0.25
_MIN_REMAINING = 4
_TRIED = 4  # photographs with the largest residuals, of which one is left out in each round
_MIN_GAIN = 2.0  # ratio of the misfits before and after
# With 6 to 8 photographs, pairs are tried as well, with a larger gain required. If two of six have
# another zoom, leaving out one after the other starts with a wrong one.
_PAIRS_AMONG, _MIN_PAIR_GAIN = (6, 8), 5.0
# Of the numbers of photographs left out, the smallest counts whose misfit is at most this multiple
# of the least one.
_NEARLY_LEAST_RATIO = 1.5
_USUAL_TERMS = ("k1", "k2")  # photographs that stand apart may have made them insignificant


def photographs_apart(problem: CalibrationProblem, state: AdjustedNetwork) -> tuple[str, ...]:
    """Return the photographs without which the others fit at least twice as well.

    They are left out one after another. Each time, the four photographs with the largest residuals
    are tried, and the one goes without which the others fit best. All stay if the others do not
    fit even without a quarter of them, nor, of six to eight photographs, without any two. A lens
    outside kgcp's models or a wrong description of the field contradicts all photographs, and is
    no reason to leave out some.
    """
    limit_px = _FITTING_RATIO * operator_sd_px(problem.views)
    most = min(int(_MAX_SHARE * len(problem.views)), len(problem.views) - _MIN_REMAINING)
    first_px = misfit_px(problem.views, state.solution)
    if most < 1 or first_px <= limit_px:
        return ()
    terms = (*_USUAL_TERMS, *(t for t in state.unknowns.terms if t not in _USUAL_TERMS))
    state = problem.with_unknowns(state, replace(state.unknowns, terms=terms))
    left_out: list[str] = []
    misfits_px, with_all = [first_px], (problem, state)
    while len(left_out) < most and misfits_px[-1] > limit_px:
        # the photograph that falsifies the camera need not have the largest residuals
        index = np.arange(len(problem.views))
        tried = np.argsort(-_view_misfits_px(problem, state))[:_TRIED].tolist()
        trials = [without(problem, state, index == view) for view in tried]
        misfits = [misfit_px(trial.views, adjusted.solution) for trial, adjusted in trials]
        best = int(np.argmin(misfits))
        left_out.append(problem.views[tried[best]].photo)
        problem, state = trials[best]
        misfits_px.append(misfits[best])
    count = int(np.argmax(np.array(misfits_px) <= _NEARLY_LEAST_RATIO * min(misfits_px)))
    # at the largest number without a fit, some that stand apart are still among the others
    is_complete = count < most or misfits_px[count] <= limit_px
    is_gain = _MIN_GAIN * misfits_px[count] <= first_px
    return tuple(left_out[:count]) if is_complete and is_gain else _pair_apart(*with_all, limit_px)


def _pair_apart(
    problem: CalibrationProblem, state: AdjustedNetwork, limit_px: float
) -> tuple[str, ...]:
    """Return the two of 6 to 8 photographs without which the others fit; empty: there are none."""
    least, most = _PAIRS_AMONG
    if not least <= len(problem.views) <= most:
        return ()
    index = np.arange(len(problem.views))
    misfits_px = {}
    for pair in combinations(index.tolist(), 2):
        others, adjusted = without(problem, state, np.isin(index, pair))
        misfits_px[pair] = misfit_px(others.views, adjusted.solution)
    best = min(misfits_px, key=misfits_px.__getitem__)
    is_gain = _MIN_PAIR_GAIN * misfits_px[best] <= misfit_px(problem.views, state.solution)
    if not is_gain or misfits_px[best] > limit_px:
        return ()
    return tuple(problem.views[view].photo for view in best)


def without(
    problem: CalibrationProblem, state: AdjustedNetwork, is_left_out: BoolArray
) -> tuple[CalibrationProblem, AdjustedNetwork]:
    """Return problem and adjustment without some photographs (v,)."""
    is_kept = ~is_left_out
    views = tuple(view for view, keeps in zip(problem.views, is_kept, strict=True) if keeps)
    problem = replace(problem, views=views)
    return problem, problem.with_estimate(state, state.estimate.part(is_kept))


def _view_misfits_px(problem: CalibrationProblem, state: AdjustedNetwork) -> FloatArray:
    """Return each photograph's RMS (v,) of comparable residuals; infinite without kept discs."""
    count = len(state.estimate.rotations)
    view = state.network.observations.view[state.solution.is_used]
    residuals = comparable_residuals(problem.views, state.solution)[state.solution.is_used]
    squares = np.sum(residuals**2, axis=1)
    discs = np.bincount(view, minlength=count)
    mean = np.bincount(view, squares, count) / np.maximum(discs, 1)
    return np.asarray(np.sqrt(np.where(discs > 0, mean, np.inf)))
