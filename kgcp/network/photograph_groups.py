"""Photographs that fall into two groups: turned by 180° as files, or by two cameras.

A program that applies the orientation of EXIF turns photographs that a phone has taken upside down.
Their principal point, and the direction of their tangential distortion, are then opposite to those
of the others. The poses take up nearly all of this, but the common principal point is wrong.

Such a photograph is one by a camera whose values of cx, cy (from the middle of the frame), p1 and
p2 have the other sign. The equations are linear in these values, so that the fit of any choice of
signs follows from blocks of the normal equations. Signs are changed one by one as long as the fit
improves, from several starts.

If photographs are by two cameras of one model, each sign adds or subtracts half of the difference
of focal length and principal point. Stabilisation, autofocus, a rolling shutter and boards that
bend also make photographs fit better in two groups. But they make every photograph differ from
every other: if each has a focal length and a principal point of its own, far more is gained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.network.calibration_records import CameraCalibration
from kgcp.network.covariance import without_pose
from kgcp.network.equations import network_rows, prior_cost, reduce_poses, view_rows
from kgcp.network.frame_camera import DISTORTION, FrameCameraModel
from kgcp.network.records import CalibrationPrior, Network, Solution

_CHANGING = ("cx", "cy", "p1", "p2")  # have the other sign in a photograph that was turned
# With fewer places, other errors of the photographs look like turned files: with 8 places, turns
# nearly halve the squares of the residuals in some simulated sessions of boards that
# bend or with a rolling shutter. In 30 sessions with 10 to 14 places, none falls below the limit.
_MIN_PLACES = 10
_MAX_LEFT = 0.7
_STARTS = 8
# Columns of what differs between two cameras: the focal length, and x and y of the principal point
_OF_CAMERA = {"fx": 0, "fy": 0, "cx": 1, "cy": 2}
# A-priori standard deviation of the difference between two cameras, relative to the focal length
# and to the width of the frame.
_OTHER_SD = 0.005
# Of what a focal length and a principal point for each photograph would explain, two cameras must
# explain this share, and the former this multiple of what chance does. In simulated sessions of 12
# to 16 photographs, the share is 1.00 to 1.02 if they are by two cameras, at most 0.77 if the
# principal point or the board moves or the shutter is rolling, and 0.9 with autofocus; without any
# of this the multiple is 1.
_LEAST_SHARE, _LEAST_RATIO = 0.95, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """Normal equations of the values that change their sign, without all other unknowns."""

    squares: float  # weighted squares of residuals and priors if the values are zero
    unknowns: int  # number of all others, without poses
    prior: FloatArray  # (c, c)
    each: FloatArray  # (v, c, c): of each photograph
    right: FloatArray  # (v, c): of each photograph
    pairs: FloatArray  # (v, v, c, c): what the other unknowns take up of each pair

    @property
    def own(self) -> FloatArray:
        """The sum over the photographs (c, c)."""
        return np.asarray(self.prior + self.each.sum(axis=0))

    def gain_of_own_values(self) -> float:
        """Return by how much the squares fall if each photograph has values of its own."""
        count, size = self.right.shape
        normal = -self.pairs.transpose(0, 2, 1, 3)
        index = np.arange(count)
        normal[index, :, index] += self.each + self.prior
        right = self.right.reshape(-1)
        return float(right @ np.linalg.solve(normal.reshape(count * size, -1), right))

    def gain(self, signs: FloatArray) -> float:
        """Return by how much the values reduce the squares, for signs (v,) of the photographs."""
        normal = self.own - np.einsum("i,j,ijab->ab", signs, signs, self.pairs)
        right = signs @ self.right
        return float(right @ np.linalg.solve(normal, right))

    def gains_of_changes(self, signs: FloatArray) -> FloatArray:
        """Return `gain` (v,) if the sign of one photograph is changed, for each of them."""
        along = np.einsum("j,ijab->iab", signs, self.pairs)
        taken = np.einsum("i,iab->ab", signs, along)
        change = 2.0 * signs[:, None, None] * (along + along.transpose(0, 2, 1))
        index = np.arange(len(signs))
        normals = self.own - taken + change - 4.0 * self.pairs[index, index]
        rights = signs @ self.right - 2.0 * signs[:, None] * self.right
        solved = np.linalg.solve(normals, rights[:, :, None])[:, :, 0]
        return np.asarray(np.sum(rights * solved, axis=1))


def turned_photographs(calibration: CameraCalibration) -> tuple[str, ...]:
    """Return the photographs that were turned by 180° against most others; empty: none were.

    Half of them may be named instead of the other half. With fewer than ten places, there is no
    answer, and none are returned.
    """
    if int(calibration.precision.places.max()) + 1 < _MIN_PLACES:
        return ()
    network = _with_fy_and_tangential_terms(calibration)
    names, camera, solution = network.model.names, calibration.camera, calibration.solution
    changing = np.array([names.index(name) for name in _CHANGING])
    estimate = replace(solution.estimate, cameras=network.cameras.values)
    middle = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1), 0.0, 0.0])
    start = estimate.cameras[0, changing] - middle
    values = np.eye(len(names))[:, changing]
    solution, prior = replace(solution, estimate=estimate), np.zeros((len(_CHANGING),) * 2)
    blocks = _blocks(network, solution, values, start, changing, prior)
    together = np.ones(len(calibration.views))
    signs = _best_signs(blocks)
    left, left_together = (blocks.squares - blocks.gain(each) for each in (signs, together))
    return () if left > _MAX_LEFT * left_together else _fewer(calibration, signs)


def other_camera(calibration: CameraCalibration) -> tuple[str, ...]:
    """Return the photographs by another camera than most others; empty: all are by one.

    With fewer than ten places, there is no answer, and none are returned.
    """
    if int(calibration.precision.places.max()) + 1 < _MIN_PLACES:
        return ()
    network, solution, camera = calibration.network, calibration.solution, calibration.camera
    names = network.model.names
    values, start = np.zeros((len(names), 3)), np.zeros(3)
    for row, name in enumerate(names):
        if name in _OF_CAMERA:
            unit = camera.width if name in ("cx", "cy") else solution.estimate.cameras[0, row]
            values[row, _OF_CAMERA[name]] = unit
    prior = np.eye(3) / _OTHER_SD**2
    blocks = _blocks(network, solution, values, start, np.array([], np.intp), prior)
    signs = _best_signs(blocks)
    count = blocks.right.size
    by_two, by_each = blocks.gain(signs), blocks.gain_of_own_values()
    unknowns = blocks.unknowns + count + 6 * len(signs)
    redundancy = 2 * int(np.count_nonzero(solution.is_used)) - unknowns
    variance = (blocks.squares - by_each) / max(redundancy, 1)
    if by_each < _LEAST_RATIO * count * variance:
        return ()
    is_explained = by_two - 3.0 * variance > _LEAST_SHARE * (by_each - count * variance)
    return _fewer(calibration, signs) if is_explained else ()


def _best_signs(blocks: _Blocks) -> FloatArray:
    """Return the signs (v,) that fit best, improved from several starts."""
    together = np.ones(len(blocks.right))
    rng = np.random.default_rng(0)
    starts = [together, *rng.choice([-1.0, 1.0], (_STARTS, len(together)))]
    return max((_improved(blocks, start) for start in starts), key=blocks.gain)


def _fewer(calibration: CameraCalibration, signs: FloatArray) -> tuple[str, ...]:
    """Return the photographs with the sign that fewer have."""
    is_fewer: BoolArray = signs * np.sign(signs.sum() or 1.0) < 0.0
    return tuple(calibration.views[k].photo for k in np.flatnonzero(is_fewer).tolist())


def _improved(blocks: _Blocks, signs: FloatArray) -> FloatArray:
    """Change signs (v,) one by one as long as the fit improves."""
    gain = blocks.gain(signs)
    while True:
        gains = blocks.gains_of_changes(signs)
        best = int(np.argmax(gains))
        if gains[best] <= gain * (1.0 + 1e-9):
            return signs
        signs, gain = signs.copy(), float(gains[best])
        signs[best] *= -1.0


def _blocks(
    network: Network,
    solution: Solution,
    values: FloatArray,
    start: FloatArray,
    replaced: IndexArray,
    prior: FloatArray,
) -> _Blocks:
    """Return the equations of values that have another sign in some photographs.

    Parameters
    ----------
    values : (p, c) array
        Change of the p parameters of the camera by each value.
    start : (c,) array
        The values in the estimate.
    replaced : (r,) array
        Numbers of the parameters that the values stand for; the others remain unknowns.
    prior : (c, c) array
        Normal matrix of the prior of the values, which are zero by it.
    """
    estimate = solution.estimate
    all_rows = network_rows(network, estimate, solution.weights)
    system = reduce_poses(network, estimate, all_rows)
    equations = view_rows(network, all_rows)
    others = np.setdiff1d(np.arange(len(system.normal)), replaced)
    couplings = np.zeros((len(equations), len(system.normal), values.shape[1]))
    squares = prior_cost(network, estimate)
    right, each = [], []
    for view, coupling in zip(equations, couplings, strict=True):
        rows, residuals = without_pose(view)
        odd = rows[:, : len(values)] @ values
        coupling[view.columns] = rows.T @ odd
        each.append(odd.T @ odd)
        unexplained = residuals + odd @ start
        squares += float(unexplained @ unexplained)
        right.append(odd.T @ unexplained)
    kept = couplings[:, others]
    inverse = np.linalg.inv(system.normal[np.ix_(others, others)])
    # what is left to the other unknowns if the values are zero
    left = system.right[others] + kept.sum(axis=0) @ start
    taken = inverse @ kept
    return _Blocks(
        squares - float(left @ inverse @ left),
        len(others),
        prior,
        np.array(each),
        np.array(right) - np.einsum("vua,u->va", taken, left),
        np.einsum("iua,jub->ijab", kept, taken),
    )


def _with_fy_and_tangential_terms(calibration: CameraCalibration) -> Network:
    """Return the network with fy, p1 and p2 among the unknowns, if they have been left out."""
    network, camera = calibration.network, calibration.camera
    known = dict(zip(network.model.names, network.cameras.sd[0].tolist(), strict=True))
    terms = tuple(term for term in DISTORTION if term in known or term in _CHANGING)
    model = FrameCameraModel(camera, terms, is_same_aspect=False)
    sd = np.array([[known.get(name, np.inf) for name in model.names]])
    return replace(
        network, model=model, cameras=CalibrationPrior(model.values_of(camera)[None], sd)
    )
