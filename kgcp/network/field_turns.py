"""How a symmetric field lies in each photograph: upright, or turned so that it looks the same."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem
from kgcp.network.start import refined_poses

_CLEAR_TURN = 1.5  # times the sum of squares: the field's own shape tells its ends apart


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """Another way in which a symmetric field may lie in a photograph."""

    cost_ratio: float  # its sum of squares over that of the present one
    permutation: IndexArray  # (m,): which disc takes the place of which
    pose: Pose


def with_turns(
    problem: CalibrationProblem, state: AdjustedNetwork
) -> tuple[CalibrationProblem, AdjustedNetwork, bool]:
    """Turn a symmetric field in photographs where its own shape fits better turned.

    Returns
    -------
    problem, state
        With the discs named accordingly.
    is_unclear : bool
        Whether some photograph fits nearly as well either way.
    """
    for _ in range(len(problem.views)):
        turns = [_best_turn(problem, state, view) for view in range(len(problem.views))]
        worst = min(range(len(turns)), key=lambda view: turns[view].cost_ratio)
        if turns[worst].cost_ratio >= 1.0:
            return problem, state, turns[worst].cost_ratio < _CLEAR_TURN
        views = list(problem.views)
        point = turns[worst].permutation[views[worst].point]
        views[worst] = replace(views[worst], point=point)
        problem = replace(problem, views=tuple(views))
        rotations, translations = (
            state.estimate.rotations.copy(),
            state.estimate.translations.copy(),
        )
        rotations[worst] = turns[worst].pose.rotation
        translations[worst] = turns[worst].pose.translation_m
        estimate = replace(state.estimate, rotations=rotations, translations=translations)
        state = problem.with_estimate(state, estimate)
    return problem, state, True


def _best_turn(problem: CalibrationProblem, state: AdjustedNetwork, view: int) -> _Turn:
    """Return how else a symmetric field could lie in a photograph."""
    observed = state.network.observations
    own = observed.chosen((observed.view == view) & state.solution.is_used)
    own = replace(own, view=np.zeros(len(own.view), dtype=np.intp))
    points, pose = state.estimate.points, state.poses[view]
    bends = state.network.bends
    _, cost = refined_poses(state.camera, own, points, [pose], bends)
    turns = []
    for permutation in problem.field.symmetries():
        turned = replace(own, point=permutation[own.point])
        guess = _turned_pose(pose, problem.field.points_m(), permutation)
        refined, other = refined_poses(state.camera, turned, points, [guess], bends)
        turns.append(
            _Turn(
                float(other[0] / cost[0]),
                permutation,
                Pose(refined.rotations[0], refined.translations[0]),
            )
        )
    return min(turns, key=lambda turn: turn.cost_ratio)


def _turned_pose(pose: Pose, points: FloatArray, turn: IndexArray) -> Pose:
    """Return the pose under which point i has the image that point turn[i] is to have."""
    middle = points.mean(axis=0)
    # turn[i] is where the turn S takes point i, so that R X_i + t = R Sᵀ X_turn[i] + t'
    across, image = (points - middle)[:, :2], (points[turn] - middle)[:, :2]
    u, _, vt = np.linalg.svd(image.T @ across)
    back = np.eye(3)
    back[:2, :2] = (u @ vt).T
    rotation = pose.rotation @ back
    return Pose(rotation, pose.rotation @ middle + pose.translation_m - rotation @ middle)
