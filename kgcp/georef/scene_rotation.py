"""Motion of the camera while a rolling shutter reads a frame, from the frames before and after.

Reference poses and the target's positions give the direction to the target in the camera frame at
the times of the frames. Its rotation at a frame is the difference between the frames before and
after, over the time between them. The uncertainty follows from the comparison with differences over
twice the time. Velocity and rotation of the camera in the ENU frame are determined in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.plate_prior import SceneRotation

_MAX_COMPARED = 8  # nearest frames from which the uncertainty of a rotation is estimated
_MIN_COMPARED = 4  # least number of such frames in a flight
# Vibration that is too fast for frames to show, as shares of the a-priori standard deviations of
# rotation and velocity. It turns a camera far more than it shifts it: at 5°/s and 30 m, the share
# of the velocity is 0.1 m/s.
_VIBRATION_SHARE, _VIBRATION_SHARE_OF_VELOCITY = 0.2, 0.04


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotions:
    """Motion of a camera in the ENU frame at n frames."""

    velocity_m_s: FloatArray  # (n, 3): of the projection centre
    sd_velocity_m_s: FloatArray  # (n,): of each component
    turn_rad_s: FloatArray  # (n, 3): rotation of the camera axes
    sd_turn_rad_s: FloatArray  # (n,): of each component
    # (n,): whether poses before and after determine the motion; otherwise it is the a-priori one,
    # whose error all frames share
    is_observed: BoolArray


def combine_with_prior(
    observed_rad_s: FloatArray, sd_rad_s: float, a_priori: SceneRotation
) -> SceneRotation:
    """Return the weighted mean of an observed rotation (3,) and the a-priori one."""
    prior = np.array(a_priori.velocity_rad_s)
    mean, sd = _weighted(observed_rad_s, sd_rad_s, prior, a_priori.sd_rad_s)
    x, y, z = mean.tolist()
    return SceneRotation((x, y, z), sd)


def rotations_between_frames(
    time_s: FloatArray,
    sight_m: FloatArray,
    camera_from_plate: FloatArray,
    a_priori: SceneRotation,
) -> list[SceneRotation]:
    """Return the scene's rotation at every frame, by central differences over neighbouring frames.

    Parameters
    ----------
    time_s : (n,) array
        Strictly ascending [s].
    sight_m : (n, 3) array
        From projection centre to target, in the camera frame [m].
    camera_from_plate : (n, 3, 3) array
        Attitude of the plate, or of the vehicle under it, in the camera frame.
    a_priori : SceneRotation
        Each observed rotation is combined with it, by their weights.

    Returns
    -------
    list of SceneRotation
        The a-priori rotation for frames without neighbours on both sides, and for all frames if
        there are too few to compare.
    """
    near, is_near = _differences(time_s, sight_m, camera_from_plate, 1)
    wide, is_wide = _differences(time_s, sight_m, camera_from_plate, 2)
    prior = np.tile(a_priori.velocity_rad_s, (len(time_s), 1))
    sd_prior = np.full(len(time_s), a_priori.sd_rad_s)
    rates, sds = _posterior(time_s, near, is_near, wide, is_wide, prior, sd_prior, _VIBRATION_SHARE)
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
    """Return velocity and rotation of a camera at n frames, by central differences over its poses.

    Parameters
    ----------
    time_s : (n,) array
        Mid-exposures [s], in any order; NaN: not known.
    centre_m, enu_from_camera : (n, 3) and (n, 3, 3) arrays
        As in `ExteriorOrientations`.
    turns : sequence of SceneRotation
        A-priori rotation of the scene in the camera frame. The a-priori velocity of the camera is
        zero; its standard deviation is that of the rotation times the distance.
    distance_m : float
        Approximate distance of what is imaged.
    """
    sds = np.array([turn.sd_rad_s for turn in turns])
    # the camera turns opposite to the scene
    turn = -np.einsum("nij,nj->ni", enu_from_camera, [turn.velocity_rad_s for turn in turns])
    velocity, sd_velocity = np.zeros_like(turn), sds * distance_m
    sd_turn, is_observed = sds.copy(), np.zeros(len(sds), dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(time_s))
    rows = known[np.unique(time_s[known], return_index=True)[1]]  # one frame per time
    at_s, centres, axes = time_s[rows], centre_m[rows], enu_from_camera[rows]
    near, is_near = _camera_rates(at_s, centres, axes, 1)
    wide, is_wide = _camera_rates(at_s, centres, axes, 2)
    turn[rows], sd_turn[rows] = _posterior(
        at_s, near[:, 3:], is_near, wide[:, 3:], is_wide, turn[rows], sds[rows], _VIBRATION_SHARE
    )
    velocity[rows], sd_velocity[rows] = _posterior(
        at_s,
        near[:, :3],
        is_near,
        wide[:, :3],
        is_wide,
        velocity[rows],
        sd_velocity[rows],
        _VIBRATION_SHARE_OF_VELOCITY,
    )
    is_observed[rows] = sd_velocity[rows] < sds[rows] * distance_m
    return CameraMotions(velocity, sd_velocity, turn, sd_turn, is_observed)


def _posterior(
    time_s: FloatArray,
    near: FloatArray,
    is_near: BoolArray,
    wide: FloatArray,
    is_wide: BoolArray,
    prior: FloatArray,
    sd_prior: FloatArray,
    vibration_share: float,
) -> tuple[FloatArray, FloatArray]:
    """Return rates (n, 3) and their standard deviations (n,): observed ones combined with priors.

    The standard deviation of an observed rate, over one frame before and after (`near`), is its RMS
    difference from the rate over two frames before and after (`wide`), in the nearest frames.
    """
    rates, sds = prior.copy(), sd_prior.copy()
    compared = np.flatnonzero(is_near & is_wide)
    if len(compared) < _MIN_COMPARED:
        return rates, sds
    off2 = np.mean((near - wide)[compared] ** 2, axis=1)
    for row in np.flatnonzero(is_near):
        # times ascend, so that the nearest frames are among as many on either side
        place = int(np.searchsorted(compared, row))
        around = np.arange(max(place - _MAX_COMPARED, 0), min(place + _MAX_COMPARED, len(compared)))
        order = np.argsort(np.abs(time_s[compared[around]] - time_s[row]), kind="stable")
        nearest = around[order[:_MAX_COMPARED]]
        sd = math.hypot(math.sqrt(float(off2[nearest].mean())), vibration_share * sd_prior[row])
        rates[row], sds[row] = _weighted(near[row], sd, prior[row], float(sd_prior[row]))
    return rates, sds


def _weighted(
    observed: FloatArray, sd: float, prior: FloatArray, sd_prior: float
) -> tuple[FloatArray, float]:
    """Return the weighted mean of two rates (3,), and its standard deviation."""
    weight = sd_prior**2 / (sd_prior**2 + sd**2)
    return weight * observed + (1.0 - weight) * prior, math.sqrt(weight) * sd


def _camera_rates(
    time_s: FloatArray, centre_m: FloatArray, enu_from_camera: FloatArray, reach: int
) -> tuple[FloatArray, BoolArray]:
    """Return velocities [m/s] and rotations [rad/s] (n, 6), and which of the n frames have them.

    They are differences between the `reach`-th frame before and the `reach`-th after.
    """
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
    """Return rotations (n, 3) [rad/s] of the scene, and which of the n frames have one.

    They are differences between the `reach`-th frame before and the `reach`-th after. The component
    across the line of sight comes from the direction to the target, the one along it from the
    plate's attitude.
    """
    count = len(time_s)
    rotation, exists = np.zeros((count, 3)), np.zeros(count, dtype=np.bool_)
    inner = slice(reach, count - reach)
    if count <= 2 * reach:
        return rotation, exists
    direction = sight_m / np.linalg.norm(sight_m, axis=1, keepdims=True)
    before, after, here = direction[: -2 * reach], direction[2 * reach :], direction[inner]
    span_s = (time_s[2 * reach :] - time_s[: -2 * reach])[:, None]
    across = np.cross(here, (after - before) / span_s)
    turned = camera_from_plate[2 * reach :] @ np.swapaxes(camera_from_plate[: -2 * reach], 1, 2)
    turn = Rotation.from_matrix(turned).as_rotvec() / span_s
    rotation[inner] = across + here * np.sum(here * turn, axis=1, keepdims=True)
    exists[inner] = True
    return rotation, exists
