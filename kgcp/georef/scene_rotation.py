"""How a camera moves while a rolling shutter reads a frame, from the frames around it.

Reference poses and the target's positions give the direction of the target in the camera frame at
the times of the frames; differences over time give its rotation at each. Their uncertainty follows
from the comparison with differences over twice the time. The same is done for the camera's shift
and turn in the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.plate_prior import SceneRotation

_NEAREST = 8  # frames from which the uncertainty of a rotation is estimated
_FEWEST = 4
# Of the a-priori deviation: vibration that is too fast for frames to show. It turns a camera far
# more than it shifts one: at 5°/s and 30 m, the latter is 0.1 m/s.
_UNSEEN_SHARE, _UNSEEN_SHARE_OF_SHIFTS = 0.2, 0.04


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotions:
    """How a camera moves in the ENU frame at n frames."""

    velocity_m_s: FloatArray  # (n, 3): of the projection centre
    sd_velocity_m_s: FloatArray  # (n,): of each component
    turn_rad_s: FloatArray  # (n, 3): of the camera axes
    sd_turn_rad_s: FloatArray  # (n,)
    # (n,): whether poses before and after tell the motion; else its error is that of all frames
    is_seen: BoolArray


def combine(observed_rad_s: FloatArray, sd_rad_s: float, a_priori: SceneRotation) -> SceneRotation:
    """Return the weighted mean of an observed rotation (3,) and of one that is known before."""
    before = np.array(a_priori.velocity_rad_s)
    mean, sd = _weighted(observed_rad_s, sd_rad_s, before, a_priori.sd_rad_s)
    x, y, z = mean.tolist()
    return SceneRotation((x, y, z), sd)


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
    near, is_near = _differences(time_s, sight_m, camera_from_plate, 1)
    wide, is_wide = _differences(time_s, sight_m, camera_from_plate, 2)
    before = np.tile(a_priori.velocity_rad_s, (len(time_s), 1))
    sd_before = np.full(len(time_s), a_priori.sd_rad_s)
    rates, sds = _believed(time_s, near, is_near, wide, is_wide, before, sd_before, _UNSEEN_SHARE)
    return [
        SceneRotation((x, y, z), sd)
        for (x, y, z), sd in zip(rates.tolist(), sds.tolist(), strict=True)
    ]


def camera_motions(
    time_s: FloatArray,
    centre_m: FloatArray,
    enu_from_camera: FloatArray,
    turns: Sequence[SceneRotation],
    distance_m: float,
) -> CameraMotions:
    """Return shift and turn of a camera at n frames, by central differences over its poses.

    Parameters
    ----------
    time_s : (n,) array
        Mid-exposures [s], in any order; NaN: not known.
    centre_m, enu_from_camera : (n, 3) and (n, 3, 3) arrays
        As of `ExteriorOrientations`.
    turns : sequence of SceneRotation
        How the scene turns about the camera, as far as that is known without the poses. By its
        deviation times the distance, the shift is zero.
    distance_m : float
        To what is seen, about.
    """
    sds = np.array([turn.sd_rad_s for turn in turns])
    # the camera turns the other way
    turn = -np.einsum("nij,nj->ni", enu_from_camera, [turn.velocity_rad_s for turn in turns])
    velocity, sd_velocity = np.zeros_like(turn), sds * distance_m
    sd_turn, is_seen = sds.copy(), np.zeros(len(sds), dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(time_s))
    rows = known[np.unique(time_s[known], return_index=True)[1]]  # one frame per time
    at_s, centres, axes = time_s[rows], centre_m[rows], enu_from_camera[rows]
    near, is_near = _shifts_and_turns(at_s, centres, axes, 1)
    wide, is_wide = _shifts_and_turns(at_s, centres, axes, 2)
    turn[rows], sd_turn[rows] = _believed(
        at_s, near[:, 3:], is_near, wide[:, 3:], is_wide, turn[rows], sds[rows], _UNSEEN_SHARE
    )
    velocity[rows], sd_velocity[rows] = _believed(
        at_s,
        near[:, :3],
        is_near,
        wide[:, :3],
        is_wide,
        velocity[rows],
        sd_velocity[rows],
        _UNSEEN_SHARE_OF_SHIFTS,
    )
    is_seen[rows] = sd_velocity[rows] < sds[rows] * distance_m
    return CameraMotions(velocity, sd_velocity, turn, sd_turn, is_seen)


def _believed(
    time_s: FloatArray,
    near: FloatArray,
    is_near: BoolArray,
    wide: FloatArray,
    is_wide: BoolArray,
    before: FloatArray,
    sd_before: FloatArray,
    unseen_share: float,
) -> tuple[FloatArray, FloatArray]:
    """Return rates (n, 3) and their deviations (n,), with what was known of them before.

    Differences over near neighbours are as good as those over wide ones agree with them.
    """
    rates, sds = before.copy(), sd_before.copy()
    compared = np.flatnonzero(is_near & is_wide)
    if len(compared) < _FEWEST:
        return rates, sds
    off2 = np.mean((near - wide)[compared] ** 2, axis=1)
    for row in np.flatnonzero(is_near):
        # times ascend: the nearest frames are among as many on either side
        place = int(np.searchsorted(compared, row))
        around = np.arange(max(place - _NEAREST, 0), min(place + _NEAREST, len(compared)))
        order = np.argsort(np.abs(time_s[compared[around]] - time_s[row]), kind="stable")
        nearest = around[order[:_NEAREST]]
        sd = math.hypot(math.sqrt(float(off2[nearest].mean())), unseen_share * sd_before[row])
        rates[row], sds[row] = _weighted(near[row], sd, before[row], float(sd_before[row]))
    return rates, sds


def _weighted(
    observed: FloatArray, sd: float, before: FloatArray, sd_before: float
) -> tuple[FloatArray, float]:
    """Return the weighted mean of two rates (3,), and its deviation."""
    weight = sd_before**2 / (sd_before**2 + sd**2)
    return weight * observed + (1.0 - weight) * before, math.sqrt(weight) * sd


def _shifts_and_turns(
    time_s: FloatArray, centre_m: FloatArray, enu_from_camera: FloatArray, reach: int
) -> tuple[FloatArray, BoolArray]:
    """Return velocities and turns (n, 6) from so many frames before to as many after."""
    count = len(time_s)
    rates, exists = np.zeros((count, 6)), np.zeros(count, dtype=np.bool_)
    if count <= 2 * reach:
        return rates, exists
    before, after, inner = slice(None, -2 * reach), slice(2 * reach, None), slice(reach, -reach)
    turned = enu_from_camera[after] @ np.swapaxes(enu_from_camera[before], 1, 2)
    moved = np.hstack(
        (centre_m[after] - centre_m[before], Rotation.from_matrix(turned).as_rotvec())
    )
    rates[inner], exists[inner] = moved / (time_s[after] - time_s[before])[:, None], True
    return rates, exists


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
