"""Check of the targets' positions against each other, from all oriented frames of a flight.

In a single frame with few targets, the pose absorbs most of a wrong position. Frames from other
directions contradict it. Therefore corrections of all positions are estimated from all frames, and
compared with the standard deviations of the positions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.network.ground.frame_poses import NO_ROTATIONS, SD_FOCAL, FramePose, point_images
from kgcp.network.ground.pose_adjustment import position_equations

_DOUBTFUL_CHI2 = 16.3  # limit of three coordinates; chance exceeds it once in 1000 targets
_SAME_CHI2 = 13.8  # targets within this Δχ² of the worst one may be the wrong one instead
# Singular values below this share count as zero: the frames do not check such a direction.
_MIN_DETERMINED = 1e-6
_MIN_SD_M = 1e-4  # lower limit of a position's standard deviation: no survey is better


@dataclass(frozen=True, slots=True, eq=False)
class WrongPosition:
    """A position that contradicts the others.

    Attributes
    ----------
    targets : tuple of str
        The target with a wrong position; several: one of them, but it is unclear which.
    off_m : float
        Error of the first target's position, if that is the wrong one.
    chi2 : float
        Decrease of χ² if the three coordinates of the first target are left out.
    """

    targets: tuple[str, ...]
    off_m: float
    chi2: float


def wrong_position(
    poses: Sequence[FramePose],
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    sd_scale: float,
    rotations: Mapping[str, SceneRotation] = NO_ROTATIONS,
) -> WrongPosition | None:
    """Return the position that the frames of a flight contradict most; None: none is doubtful.

    Parameters
    ----------
    poses : sequence of FramePose
        Result of `orient_frames` for the other arguments.
    """
    by_frame_and_target = {
        (each.frame, each.target): each for each in sightings if not each.instance
    }
    of_frames = (pose.used for pose in poses if pose.residuals is not None)
    names = list(dict.fromkeys(name for used in of_frames for name in used))
    if not names:
        return None
    normal, right, squares, freedom = _equations(
        poses, by_frame_and_target, positions, names, camera, sd_scale, rotations
    )
    prior = np.zeros_like(normal)
    for row, name in enumerate(names):
        cov = positions[name].cov_m2
        position_cov = _MIN_SD_M**2 * np.eye(3) + (0.0 if cov is None else cov)
        prior[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = position_cov
    # residuals that no corrections explain scale the noise of the images, but not the prior
    free = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    factor = max(1.0, (squares - float(free @ right)) / max(1, freedom - 3 * len(names)))
    gain = np.linalg.solve(np.eye(len(normal)) + prior @ (normal / factor), prior)
    corrections, correction_cov = gain @ right / factor, prior - gain
    blocks = [slice(3 * row, 3 * row + 3) for row in range(len(names))]
    solved = [
        np.linalg.lstsq(correction_cov[at, at], corrections[at], rcond=_MIN_DETERMINED)[0]
        for at in blocks
    ]
    chi2 = np.array([corrections[at] @ w for at, w in zip(blocks, solved, strict=True)])
    worst = int(np.argmax(chi2))
    if chi2[worst] < _DOUBTFUL_CHI2:
        return None
    suspects = [row for row in np.argsort(-chi2) if chi2[worst] - chi2[row] < _SAME_CHI2]
    off_m = prior[blocks[worst], blocks[worst]] @ solved[worst]
    return WrongPosition(
        tuple(names[row] for row in suspects), float(np.linalg.norm(off_m)), float(chi2[worst])
    )


def _equations(
    poses: Sequence[FramePose],
    by_frame_and_target: Mapping[tuple[str, str], Sighting],
    positions: Mapping[str, TargetPosition],
    names: Sequence[str],
    camera: Camera,
    sd_scale: float,
    rotations: Mapping[str, SceneRotation],
) -> tuple[FloatArray, FloatArray, float, int]:
    """Return normal matrix, right-hand side, weighted squares and redundancy of all frames."""
    normal, right = np.zeros((3 * len(names), 3 * len(names))), np.zeros(3 * len(names))
    squares, freedom = 0.0, 0
    for pose in poses:
        if pose.pose is None or pose.residuals is None:
            continue
        used = pose.used
        sightings = [by_frame_and_target[pose.frame, name] for name in used]
        images = point_images(sightings, positions, sd_scale, camera, rotations.get(pose.frame))
        has_free_focal = pose.sd_focal_scale is not None
        equations = position_equations(camera, images, pose.pose, SD_FOCAL * has_free_focal)
        if equations is None:
            continue
        at = np.ravel([3 * names.index(name) + np.arange(3) for name in used])
        normal[np.ix_(at, at)] += equations[0]
        right[at] += equations[1]
        squares += equations[2]
        freedom += 2 * len(used) + int(np.count_nonzero(images.has_distance)) - 6 - has_free_focal
    return normal, right, squares, freedom
