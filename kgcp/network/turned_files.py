"""Photographs whose files were turned by 180° after they were taken.

A program that applies the orientation of EXIF turns photographs that a phone has taken upside down.
Their principal point, and the direction of their tangential distortion, are then opposite to those
of the others. The poses take up nearly all of this, but the common principal point is wrong.

Such a photograph is one by a camera whose values of cx, cy (from the middle of the frame), p1 and
p2 have the other sign. The equations are linear in these values, so that the fit of any choice of
signs follows from blocks of the normal equations. Signs are changed one by one as long as the fit
improves, from several starts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.network.calibration_records import CameraCalibration
from kgcp.network.covariance import without_pose
from kgcp.network.equations import prior_cost, reduce_poses, view_rows
from kgcp.network.frame_camera import DISTORTION, FrameCameraModel
from kgcp.network.records import CalibrationPrior, Network

_CHANGING = ("cx", "cy", "p1", "p2")  # have the other sign in a photograph that was turned
# With fewer places, other errors of the photographs look like turned files: with 8 places, turns
# nearly halve the squares of the residuals in some simulated sessions of boards that
# bend or with a rolling shutter. In 30 sessions with 10 to 14 places, none falls below the limit.
_MIN_PLACES = 10
_MAX_LEFT = 0.7
_STARTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    """Normal equations of the values that change their sign, without all other unknowns."""

    squares: float  # weighted squares of residuals and priors if the values are zero
    own: FloatArray  # (4, 4): sum over the photographs
    right: FloatArray  # (v, 4): of each photograph
    pairs: FloatArray  # (v, v, 4, 4): what the other unknowns take up of each pair

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
    blocks = _blocks(calibration)
    together = np.ones(len(calibration.views))
    rng = np.random.default_rng(0)
    starts = [together, *rng.choice([-1.0, 1.0], (_STARTS, len(together)))]
    signs = max((_improved(blocks, start) for start in starts), key=blocks.gain)
    left, left_together = (blocks.squares - blocks.gain(each) for each in (signs, together))
    if left > _MAX_LEFT * left_together:
        return ()
    is_turned: BoolArray = signs * np.sign(signs.sum() or 1.0) < 0.0
    return tuple(calibration.views[k].photo for k in np.flatnonzero(is_turned).tolist())


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


def _blocks(calibration: CameraCalibration) -> _Blocks:
    network = _with_fy_and_tangential_terms(calibration)
    names, camera = network.model.names, calibration.camera
    changing = np.array([names.index(name) for name in _CHANGING])
    solution = calibration.solution
    estimate = replace(solution.estimate, cameras=network.cameras.values)
    middle = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1), 0.0, 0.0])
    start = estimate.cameras[0, changing] - middle
    equations = view_rows(network, estimate, solution.weights)
    system = reduce_poses(network, estimate, equations)
    others = np.setdiff1d(np.arange(len(system.normal)), changing)
    couplings = np.zeros((len(equations), len(system.normal), len(changing)))
    squares = prior_cost(network, estimate)
    right, own = [], np.zeros((len(changing), len(changing)))
    for view, coupling in zip(equations, couplings, strict=True):
        rows, residuals = without_pose(view)
        odd = rows[:, changing]
        coupling[view.columns] = rows.T @ odd
        own += odd.T @ odd
        unexplained = residuals + odd @ start
        squares += float(unexplained @ unexplained)
        right.append(odd.T @ unexplained)
    kept = couplings[:, others]
    inverse = np.linalg.inv(system.normal[np.ix_(others, others)])
    # what is left to the other unknowns if the changing values are zero
    left = system.right[others] + kept.sum(axis=0) @ start
    taken = inverse @ kept
    return _Blocks(
        squares - float(left @ inverse @ left),
        own,
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
