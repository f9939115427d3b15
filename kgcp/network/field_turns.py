"""Orientation of a symmetric field in each photograph: as named, or turned to look the same.

Images alone do not show the difference. But the true shape of the field is not exactly symmetric,
and once it is estimated, one of the orientations fits better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.pose import Pose
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem
from kgcp.network.start import refined_poses

# Smallest ratio of the sums of squares, of the next best to the best orientation, from which on the
# shape of the field distinguishes the two.
_CLEAR_COST_RATIO = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """A symmetry of the field applied in one photograph."""

    cost_ratio: float  # its sum of squares over that of the present orientation
    permutation: IndexArray  # (m,): disc permutation[i] takes the place of disc i
    pose: Pose


def with_turns(
    problem: CalibrationProblem, state: AdjustedNetwork
) -> tuple[CalibrationProblem, AdjustedNetwork, bool]:
    """Rename the discs of photographs in which the shape of a symmetric field fits better turned.

    Returns
    -------
    problem, state
        With the discs renamed.
    is_unclear : bool
        Whether two orientations fit nearly equally well in some photograph.
    """
    for _ in range(len(problem.views)):
        turns = [_best_turn(problem, state, view) for view in range(len(problem.views))]
        worst = min(range(len(turns)), key=lambda view: turns[view].cost_ratio)
        if turns[worst].cost_ratio >= 1.0:
            return problem, state, turns[worst].cost_ratio < _CLEAR_COST_RATIO
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
    """Return the best of the other orientations of a symmetric field in a photograph."""
    observed = state.network.observations
    in_view = observed.chosen((observed.view == view) & state.solution.is_used)
    in_view = replace(in_view, view=np.zeros(len(in_view.view), dtype=np.intp))
    points, pose = state.estimate.points, state.poses[view]
    bends = state.network.bends
    _, cost = refined_poses(state.camera, in_view, points, [pose], bends)
    turns = []
    for permutation in problem.field.symmetries():
        turned = replace(in_view, point=permutation[in_view.point])
        guess = _turned_pose(pose, problem.field.points_m(), permutation)
        refined, turned_cost = refined_poses(state.camera, turned, points, [guess], bends)
        turns.append(
            _Turn(
                float(turned_cost[0] / cost[0]),
                permutation,
                Pose(refined.rotations[0], refined.translations[0]),
            )
        )
    return min(turns, key=lambda turn: turn.cost_ratio)


def _turned_pose(pose: Pose, points: FloatArray, turn: IndexArray) -> Pose:
    """Return the pose in which point turn[i] has the image that point i has in the given pose."""
    middle = points.mean(axis=0)
    # The symmetry S takes point i to point turn[i]: R X_i + t = R Sᵀ X_turn[i] + t'.
    across, image = (points - middle)[:, :2], (points[turn] - middle)[:, :2]
    u, _, vt = np.linalg.svd(image.T @ across)
    back = np.eye(3)
    back[:2, :2] = (u @ vt).T
    rotation = pose.rotation @ back
    return Pose(rotation, pose.rotation @ middle + pose.translation_m - rotation @ middle)
