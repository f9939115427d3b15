"""Positions of targets against each other, by all oriented frames of a flight together.

A pose takes up most of what a wrong position does to the few targets of one frame. Frames from
other sides contradict that: the corrections that all positions need to fit all frames are
estimated, and compared with how well the positions are known.
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

_DOUBTFUL_CHI2 = 16.3  # of three coordinates: by chance once in 1000 targets
_ALIKE_CHI2 = 13.8  # difference from which on another target's position is not the wrong one
_LEAST_DETERMINED = 1e-6  # share of the variance of a coordinate that frames hardly check
_FLOOR_M = 1e-4  # of a position's standard deviation: no survey is better


@dataclass(frozen=True, slots=True, eq=False)
class WrongPosition:
    """Positions that contradict each other.

    Attributes
    ----------
    targets : tuple of str
        The one whose position is wrong; several: one of them, it cannot be told which.
    off_m : float
        How far the first one of them is off, if it is that.
    chi2 : float
        Decrease of χ² if its three coordinates are not believed.
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
        By `orient_frames`, of the other arguments.
    """
    seen = {(each.frame, each.target): each for each in sightings if not each.instance}
    of_frames = (pose.used for pose in poses if pose.residuals is not None)
    names = list(dict.fromkeys(name for used in of_frames for name in used))
    if not names:
        return None
    normal, right, squares, freedom = _equations(
        poses, seen, positions, names, camera, sd_scale, rotations
    )
    prior = np.zeros_like(normal)
    for row, name in enumerate(names):
        cov = positions[name].cov_m2
        own = _FLOOR_M**2 * np.eye(3) + (0.0 if cov is None else cov)
        prior[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = own
    # residuals that no positions explain scale the noise, but not that of the positions
    free = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    factor = max(1.0, (squares - float(free @ right)) / max(1, freedom - 3 * len(names)))
    gain = np.linalg.solve(np.eye(len(normal)) + prior @ (normal / factor), prior)
    corrections, lost = gain @ right / factor, prior - gain
    blocks = [slice(3 * row, 3 * row + 3) for row in range(len(names))]
    solved = [
        np.linalg.lstsq(lost[at, at], corrections[at], rcond=_LEAST_DETERMINED)[0] for at in blocks
    ]
    chi2 = np.array([corrections[at] @ each for at, each in zip(blocks, solved, strict=True)])
    worst = int(np.argmax(chi2))
    if chi2[worst] < _DOUBTFUL_CHI2:
        return None
    alike = [row for row in np.argsort(-chi2) if chi2[worst] - chi2[row] < _ALIKE_CHI2]
    off_m = prior[blocks[worst], blocks[worst]] @ solved[worst]
    return WrongPosition(
        tuple(names[row] for row in alike), float(np.linalg.norm(off_m)), float(chi2[worst])
    )


def _equations(
    poses: Sequence[FramePose],
    seen: Mapping[tuple[str, str], Sighting],
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
        sightings = [seen[pose.frame, name] for name in used]
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
