"""How fast a target goes by while a rolling shutter reads a frame, from the frames around it.

Reference poses and the target's positions give the direction of the target in the camera frame at
the times of the frames; differences over time give its rotation at each. Their uncertainty follows
from the comparison with differences over twice the time.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.plate_prior import SceneRotation

_NEAREST = 8  # frames from which the uncertainty of a rotation is estimated
_FEWEST = 4
_UNSEEN_SHARE = 0.2  # of the a-priori deviation: vibration that is too fast for frames to show


def combine(observed_rad_s: FloatArray, sd_rad_s: float, a_priori: SceneRotation) -> SceneRotation:
    """Return the weighted mean of an observed rotation (3,) and of one that is known before."""
    weight = a_priori.sd_rad_s**2 / (a_priori.sd_rad_s**2 + sd_rad_s**2)
    mean = weight * observed_rad_s + (1.0 - weight) * np.array(a_priori.velocity_rad_s)
    x, y, z = mean.tolist()
    return SceneRotation((x, y, z), math.sqrt(weight) * sd_rad_s)


def rotations_between_frames(
    time_s: FloatArray,
    sight_m: FloatArray,
    camera_from_plate: FloatArray,
    a_priori: SceneRotation,
) -> list[SceneRotation]:
    """Return the scene's rotation at every frame, by central differences over its neighbours.

    Parameters
    ----------
    time_s : (n,) array
        Strictly ascending [s].
    sight_m : (n, 3) array
        From projection centre to target, in the camera frame [m].
    camera_from_plate : (n, 3, 3) array
        How the plate, or the vehicle under it, is turned in the camera frame.
    a_priori : SceneRotation
        What each rotation is combined with, by their weights.

    Returns
    -------
    list of SceneRotation
        For frames without neighbours on both sides, and in flights with too few frames to compare,
        it is the a-priori one.
    """
    count = len(time_s)
    near, is_near = _differences(time_s, sight_m, camera_from_plate, 1)
    wide, is_wide = _differences(time_s, sight_m, camera_from_plate, 2)
    compared = np.flatnonzero(is_near & is_wide)
    if len(compared) < _FEWEST:
        return [a_priori] * count
    off2 = np.mean((near - wide)[compared] ** 2, axis=1)
    rotations = []
    for row in range(count):
        if not is_near[row]:
            rotations.append(a_priori)
            continue
        # times ascend: the nearest frames are among as many on either side
        place = int(np.searchsorted(compared, row))
        around = np.arange(max(place - _NEAREST, 0), min(place + _NEAREST, len(compared)))
        order = np.argsort(np.abs(time_s[compared[around]] - time_s[row]), kind="stable")
        nearest = around[order[:_NEAREST]]
        sd = math.hypot(math.sqrt(float(off2[nearest].mean())), _UNSEEN_SHARE * a_priori.sd_rad_s)
        rotations.append(combine(near[row], sd, a_priori))
    return rotations


def _differences(
    time_s: FloatArray, sight_m: FloatArray, camera_from_plate: FloatArray, reach: int
) -> tuple[FloatArray, BoolArray]:
    """Return rotations (n, 3) [rad/s] from so many frames before to as many after, and which exist.

    The part across the line of sight is that of the direction; the part along it is that of the
    plate.
    """
    count = len(time_s)
    rotation, exists = np.zeros((count, 3)), np.zeros(count, dtype=np.bool_)
    inner = slice(reach, count - reach)
    if count <= 2 * reach:
        return rotation, exists
    ahead = sight_m / np.linalg.norm(sight_m, axis=1, keepdims=True)
    before, after, here = ahead[: -2 * reach], ahead[2 * reach :], ahead[inner]
    span_s = (time_s[2 * reach :] - time_s[: -2 * reach])[:, None]
    across = np.cross(here, (after - before) / span_s)
    turned = camera_from_plate[2 * reach :] @ np.swapaxes(camera_from_plate[: -2 * reach], 1, 2)
    turn = Rotation.from_matrix(turned).as_rotvec() / span_s
    rotation[inner] = across + here * np.sum(here * turn, axis=1, keepdims=True)
    exists[inner] = True
    return rotation, exists
