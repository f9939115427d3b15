"""Photographs that stand apart: by another zoom, focus or crop, or of a field bent otherwise.

One of them displaces the camera of all, and rejecting discs one by one does not tell them: its pose
takes up most of what is wrong, and what is left is spread over all photographs. But without it, the
others fit.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.network.calibration_records import operator_sd_px, rms_px
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem

_FITTING = 1.5  # RMS over the discs' own deviation, that leaves nothing to explain
_MOST_APART = 0.25  # of the photographs
_LEAST_LEFT = 4
_TRIED = 4  # with the largest residuals, each round
_LEAST_GAIN = 2.0  # by how much the others must fit better
# Of so few photographs two at once are left out, if the others fit so much better: one after the
# other, the wrong one goes first where two of six are by another zoom.
_PAIRS_AMONG, _LEAST_GAIN_BY_PAIR = (6, 8), 5.0
_NEARLY = 1.5  # RMS over the least one: fewer photographs are left out then
_USUAL_TERMS = ("k1", "k2")  # which photographs that stand apart may have made insignificant


def photographs_apart(problem: CalibrationProblem, state: AdjustedNetwork) -> tuple[str, ...]:
    """Return the photographs without which the others fit at least twice as well.

    One after another is left out: of those with the largest residuals, the one without which the
    others fit best. If they do not fit without a quarter of them, nor six to eight without two, all
    stay. What all photographs contradict is no reason to leave out any: a lens that is none of
    kgcp's, or a field that is not stated right.
    """
    limit_px = _FITTING * operator_sd_px(problem.views)
    most = min(int(_MOST_APART * len(problem.views)), len(problem.views) - _LEAST_LEFT)
    first_px = rms_px(state.solution)
    if most < 1 or first_px <= limit_px:
        return ()
    terms = (*_USUAL_TERMS, *(t for t in state.unknowns.terms if t not in _USUAL_TERMS))
    state = problem.with_unknowns(state, replace(state.unknowns, terms=terms))
    left_out: list[str] = []
    misfits_px, whole = [first_px], (problem, state)
    while len(left_out) < most and misfits_px[-1] > limit_px:
        # the one that displaces the camera need not be the one that fits worst in it
        index = np.arange(len(problem.views))
        tried = np.argsort(-_own_rms_px(state))[:_TRIED].tolist()
        trials = [without(problem, state, index == each) for each in tried]
        misfits = [rms_px(trial.solution) for _, trial in trials]
        best = int(np.argmin(misfits))
        left_out.append(problem.views[tried[best]].photo)
        problem, state = trials[best]
        misfits_px.append(misfits[best])
    count = int(np.argmax(np.array(misfits_px) <= _NEARLY * min(misfits_px)))
    is_cleared = count < most or misfits_px[count] <= limit_px  # else some are still among them
    is_gain = _LEAST_GAIN * misfits_px[count] <= first_px
    return tuple(left_out[:count]) if is_cleared and is_gain else _pair_apart(*whole, limit_px)


def _pair_apart(
    problem: CalibrationProblem, state: AdjustedNetwork, limit_px: float
) -> tuple[str, ...]:
    """Return two photographs without which few others fit; none if there are no such two."""
    least, most = _PAIRS_AMONG
    if not least <= len(problem.views) <= most:
        return ()
    index = np.arange(len(problem.views))
    misfits_px = {
        pair: rms_px(without(problem, state, np.isin(index, pair))[1].solution)
        for pair in combinations(index.tolist(), 2)
    }
    best = min(misfits_px, key=misfits_px.__getitem__)
    is_gain = _LEAST_GAIN_BY_PAIR * misfits_px[best] <= rms_px(state.solution)
    if not is_gain or misfits_px[best] > limit_px:
        return ()
    return tuple(problem.views[each].photo for each in best)


def without(
    problem: CalibrationProblem, state: AdjustedNetwork, is_left_out: BoolArray
) -> tuple[CalibrationProblem, AdjustedNetwork]:
    """Return problem and adjustment without some photographs (v,)."""
    stays = ~is_left_out
    views = tuple(view for view, is_in in zip(problem.views, stays, strict=True) if is_in)
    problem = replace(problem, views=views)
    return problem, problem.with_estimate(state, state.estimate.part(stays))


def _own_rms_px(state: AdjustedNetwork) -> FloatArray:
    """Return the RMS of every photograph's residuals (v,), of kept discs; infinite: it has none."""
    count = len(state.estimate.rotations)
    view = state.network.observations.view[state.solution.is_used]
    squares = np.sum(state.solution.residuals[state.solution.is_used] ** 2, axis=1)
    discs = np.bincount(view, minlength=count)
    mean = np.bincount(view, squares, count) / np.maximum(discs, 1)
    return np.asarray(np.sqrt(np.where(discs > 0, mean, np.inf)))
