"""Choice of the camera parameters that are worth estimating."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.network.adjust import ROBUST, adjust_network
from kgcp.network.bursts import place_numbers
from kgcp.network.calibration_records import LensModel, PointModel
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem, NetworkUnknowns
from kgcp.network.covariance import precision
from kgcp.network.field_deviation import field_deviation
from kgcp.network.records import Network, Observations, PointPrior
from kgcp.network.start import refined_poses

# Largest standard deviation of a parameter that counts as determined, relative to the a-priori one.
DETERMINED = 0.3
_SIGNIFICANCE_LEVEL = 0.001
_FOLDS = 5
_MIN_GAIN = 0.005  # relative decrease of the misfit in cross-validation
# Largest length of the mean unit vector of the field's directions in the photographs. Directions
# are doubled, so that opposite ones agree. Above this limit, the camera was hardly rotated about
# its axis; a stretched print then looks like pixels that are not square.
_MAX_DIRECTION_MEAN = 0.95

_TERMS: dict[LensModel, tuple[str, ...]] = {
    LensModel.RADIAL: ("k1", "k2"),
    LensModel.BROWN: ("k1", "k2", "p1", "p2", "k3"),
    LensModel.RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_ASPECT = ("fy",)
_ADDITIONS: tuple[tuple[str, ...], ...] = (_ASPECT, ("k2",), ("p1", "p2"), ("k3",))


def with_chosen_parameters(problem: CalibrationProblem, state: AdjustedNetwork) -> AdjustedNetwork:
    """Return the adjustment with the requested distortion terms, or with those worth estimating.

    k1 is always estimated. Another term, or a second focal length, is worth estimating under three
    conditions. It is significant by its scatter between places. It is known better than a priori.
    And in cross-validation, places left out of the estimation fit better with it.
    """
    settings = problem.settings
    terms = _TERMS.get(settings.lens, ("k1",))
    kept = problem.with_unknowns(state, replace(state.unknowns, terms=terms, is_same_aspect=True))
    if settings.is_same_aspect is False:
        kept = problem.with_unknowns(kept, _with(kept.unknowns, _ASPECT))
    places = place_numbers(kept.network, kept.estimate)
    if settings.lens is not LensModel.AUTO or not places.any():
        return kept
    validation = _CrossValidation(kept.network.observations, kept.solution.is_used, places)
    misfit = validation.misfit(kept)
    is_aspect_open = settings.is_same_aspect is None and _is_camera_turned(kept)
    for addition in _ADDITIONS if is_aspect_open else _ADDITIONS[1:]:
        trial = problem.with_unknowns(kept, _with(kept.unknowns, addition))
        trial_misfit = validation.misfit(trial)
        is_better = trial_misfit < (1.0 - _MIN_GAIN) * misfit
        if is_better and _is_significant(trial, addition):
            kept, misfit = trial, trial_misfit
    return kept


def _with(unknowns: NetworkUnknowns, addition: tuple[str, ...]) -> NetworkUnknowns:
    if addition == _ASPECT:
        return replace(unknowns, is_same_aspect=False)
    return replace(unknowns, terms=(*unknowns.terms, *addition))


def _is_camera_turned(state: AdjustedNetwork) -> bool:
    """Tell whether some photographs were taken with the camera rotated about its axis."""
    across = state.estimate.rotations[:, :2, 0]
    directions = np.arctan2(across[:, 1], across[:, 0])
    return bool(np.abs(np.mean(np.exp(2j * directions))) < _MAX_DIRECTION_MEAN)


def _is_significant(state: AdjustedNetwork, addition: Sequence[str]) -> bool:
    """Tell whether all added terms are determined and at least one is significant."""
    estimated = precision(state.network, state.solution)
    freedom = max(int(estimated.places.max()), 1)
    limit = stats.t.ppf(1.0 - 0.5 * _SIGNIFICANCE_LEVEL / len(addition), freedom)
    cov = estimated.camera_cov
    names = state.network.model.names
    values = state.estimate.cameras[0]
    columns = [names.index(name) for name in addition]
    if tuple(addition) == _ASPECT:  # tests fy - fx
        slope = np.zeros(len(names))
        slope[[names.index("fx"), *columns]] = -1.0, 1.0
        return bool(abs(slope @ values) > limit * np.sqrt(slope @ cov @ slope))
    sd = np.sqrt(cov.diagonal()[columns])
    is_determined = sd < DETERMINED * state.network.cameras.sd[0, columns]
    is_large = np.abs(values[columns]) > limit * sd
    return bool(is_determined.all() and is_large.any())


def with_all_terms(problem: CalibrationProblem, state: AdjustedNetwork) -> AdjustedNetwork:
    """Return the adjustment with the terms that were left out because they are not significant.

    A term that is not significant need not be zero. Without it, others take up its effect: the
    principal point that of p1 and p2, and k1 that of k2 and k3. Their standard deviations would
    not include this. Therefore all terms are estimated in the end, with priors of usual lenses.

    If a stiff field is not as stated, the terms stay zero, because they would absorb its errors: on
    BoofCV's regular sheet, the principal point would move by 4 px away from that of a free field.
    """
    if problem.settings.lens is not LensModel.AUTO:
        return state
    is_stiff = state.unknowns.points is PointModel.STIFF
    if is_stiff and field_deviation(problem.field, problem.views, state.estimate.points).doubt:
        return state
    terms = state.unknowns.terms
    left_out = tuple(term for term in _TERMS[LensModel.BROWN] if term not in terms)
    if not left_out:
        return state
    return problem.with_unknowns(state, replace(state.unknowns, insignificant=left_out))


@dataclass(frozen=True, slots=True, eq=False)
class _CrossValidation:
    """Cross-validation: places are left out of the estimation in turn.

    All models are judged by the same discs with the same covariances.
    """

    observations: Observations
    is_used: BoolArray
    places: IndexArray  # (v,): place of each photograph, by `place_numbers`

    def misfit(self, state: AdjustedNetwork) -> float:
        """Return the mean square of the whitened residuals in places that were left out."""
        network, estimate = state.network, state.estimate
        # the field stays as estimated from all places: only the camera is tested
        points = PointPrior(estimate.points, None)
        training = replace(
            network,
            points=points,
            observations=network.observations.chosen(state.solution.is_used),
        )
        measured = replace(network.observations, cov=self.observations.cov)
        validation = replace(training, observations=measured.chosen(self.is_used))
        misfits: list[FloatArray] = []
        for fold in range(min(_FOLDS, int(self.places.max()) + 1)):
            is_left_out = self.places % _FOLDS == fold
            start = estimate.part(~is_left_out)
            values = adjust_network(_part(training, ~is_left_out), start, ROBUST).estimate.cameras[
                0
            ]
            left_out = _part(validation, is_left_out).observations
            poses = [state.poses[view] for view in np.flatnonzero(is_left_out).tolist()]
            camera = state.model.camera(values)
            _, costs = refined_poses(camera, left_out, estimate.points, poses, network.bends)
            misfits.append(costs / np.bincount(left_out.view))
        return float(np.mean(np.concatenate(misfits)))


def _part(network: Network, which: BoolArray) -> Network:
    """Return the network of some of its photographs."""
    index = np.cumsum(which) - 1
    observed = network.observations.chosen(which[network.observations.view])
    return replace(
        network,
        view_camera=network.view_camera[which],
        observations=replace(observed, view=index[observed.view]),
    )
