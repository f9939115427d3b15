"""Motion of the camera while a rolling shutter reads a frame, from the frames before and after.

Reference poses and the target's positions give the direction to the target in the camera frame at
the times of the frames. Its rotation at a frame is the difference between the frames before and
after, over the time between them. The uncertainty follows from the comparison with differences over
twice the time. Velocity and rotation of the camera in the ENU frame are determined in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.measurement.plate_prior import SceneRotation

_MAX_COMPARED = 8  # nearest frames from which the uncertainty of a rotation is estimated
_MIN_COMPARED = 4  # least number of such frames in a flight
_MAX_UNLIKE = 0.5  # RMS difference of rates that predict each other, relative to their own RMS
_MAX_INTERVALS = 1.5  # to the neighbour of the first frame or the last, in usual intervals
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

    def after(
        self, orientations: ExteriorOrientations, rows: Sequence[int], delay_s: FloatArray
    ) -> ExteriorOrientations:
        """Return n orientations as they are some time after those of the poses.

        The covariances include that of the motion.

        Parameters
        ----------
        orientations : ExteriorOrientations
            Of all frames.
        rows : sequence of int
            Which of them, n times.
        delay_s : (n,) array
            Time after each.
        """
        at = [*rows]
        shift_m = delay_s[:, None] * self.velocity_m_s[at]
        turns = Rotation.from_rotvec(delay_s[:, None] * self.turn_rad_s[at]).as_matrix()
        cov = np.zeros((len(at), 6, 6))
        cov[:, range(3), range(3)] = ((delay_s * self.sd_velocity_m_s[at]) ** 2)[:, None]
        cov[:, range(3, 6), range(3, 6)] = ((delay_s * self.sd_turn_rad_s[at]) ** 2)[:, None]
        return replace(
            orientations,
            centre_m=orientations.centre_m[at] + shift_m,
            enu_from_camera=turns @ orientations.enu_from_camera[at],
            cov=cov if orientations.cov is None else orientations.cov[at] + cov,
        )


def more_certain(by_rates: SceneRotation, by_frames: SceneRotation | None) -> SceneRotation:
    """Return the rotation by the camera's rates, unless that by the frames around is better known.

    They are not averaged: the frames around do not show vibration, which the rates do.
    """
    if by_frames is not None and by_frames.sd_rad_s < by_rates.sd_rad_s:
        return by_frames
    return by_rates


def rotations_between_frames(
    time_s: FloatArray,
    sight_m: FloatArray,
    camera_from_plate: FloatArray,
    a_priori: SceneRotation,
    vibration_share: float = _VIBRATION_SHARE,
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
    vibration_share : float
        What the frames do not show, as a share of the a-priori standard deviation.

    Returns
    -------
    list of SceneRotation
        The a-priori rotation for all frames if there are too few to compare.
    """
    near, is_near = _differences(time_s, sight_m, camera_from_plate, 1)
    wide, is_wide = _differences(time_s, sight_m, camera_from_plate, 2)
    prior = np.tile(a_priori.velocity_rad_s, (len(time_s), 1))
    sd_prior = np.full(len(time_s), a_priori.sd_rad_s)
    rates, sds = _posterior(time_s, near, is_near, wide, is_wide, prior, sd_prior, vibration_share)
    return [
        SceneRotation((x, y, z), sd)
        for (x, y, z), sd in zip(rates.tolist(), sds.tolist(), strict=True)
    ]


def rotations_by_places(
    time_s: FloatArray,
    sight_m: FloatArray,
    enu_from_camera: FloatArray,
    enu_from_plate: FloatArray,
    a_priori: SceneRotation,
) -> list[SceneRotation]:
    """Return what camera and plate add to the scene's rotation by their places, at every frame.

    It is the scene's rotation without that of the camera itself, and hardly has any vibration.

    Parameters
    ----------
    sight_m : (n, 3) array
        From projection centre to target, in ENU axes [m].
    enu_from_camera, enu_from_plate : (n, 3, 3) arrays
    time_s, a_priori
        As `rotations_between_frames`.

    Returns
    -------
    list of SceneRotation
        About the camera's axes.
    """
    about_enu = rotations_between_frames(
        time_s, sight_m, enu_from_plate, a_priori, _VIBRATION_SHARE_OF_VELOCITY
    )
    about_camera = np.einsum(
        "nji,nj->ni", enu_from_camera, [rotation.velocity_rad_s for rotation in about_enu]
    )
    return [
        SceneRotation((x, y, z), rotation.sd_rad_s)
        for (x, y, z), rotation in zip(about_camera.tolist(), about_enu, strict=True)
    ]


def camera_motions(
    time_s: FloatArray,
    centre_m: FloatArray,
    enu_from_camera: FloatArray,
    rates: Sequence[SceneRotation | None],
    unknown: SceneRotation,
    distance_m: float,
) -> CameraMotions:
    """Return velocity and rotation of a camera at n frames, by central differences over its poses.

    Parameters
    ----------
    time_s : (n,) array
        Mid-exposures [s], in any order; NaN: not known.
    centre_m, enu_from_camera : (n, 3) and (n, 3, 3) arrays
        As in `ExteriorOrientations`.
    rates : sequence of SceneRotation or None
        Rotation of the scene by the camera's own rates, in the camera frame; None: not measured.
    unknown : SceneRotation
        A-priori rotation of the scene. The a-priori velocity of the camera is zero; its standard
        deviation is that of the rotation times the distance.
    distance_m : float
        Approximate distance of what is imaged.
    """
    sds = np.full(len(time_s), unknown.sd_rad_s)
    turn, velocity = np.zeros((len(sds), 3)), np.zeros((len(sds), 3))
    sd_turn, sd_velocity = sds.copy(), sds * distance_m
    is_observed = np.zeros(len(sds), dtype=np.bool_)
    known = np.flatnonzero(np.isfinite(time_s))
    rows = known[np.unique(time_s[known], return_index=True)[1]]  # one frame per time
    at_s, centres, axes = time_s[rows], centre_m[rows], enu_from_camera[rows]
    near, is_near = _camera_rates(at_s, centres, axes, 1)
    wide, is_wide = _camera_rates(at_s, centres, axes, 2)
    for part, rate, sd, share in (
        (slice(0, 3), velocity, sd_velocity, _VIBRATION_SHARE_OF_VELOCITY),
        (slice(3, 6), turn, sd_turn, _VIBRATION_SHARE),
    ):
        rate[rows], sd[rows] = _posterior(
            at_s, near[:, part], is_near, wide[:, part], is_wide, rate[rows], sd[rows], share
        )
    for row, measured in enumerate(rates):
        if measured is not None and measured.sd_rad_s < sd_turn[row]:
            # the camera turns opposite to the scene
            turn[row] = -enu_from_camera[row] @ np.array(measured.velocity_rad_s)
            sd_turn[row] = measured.sd_rad_s
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
    difference from the rate over two frames before and after (`wide`), in the nearest frames. The
    first frame and the last have the rate of their neighbour, with the RMS change from one frame
    to the next. What the flight does by these rates is a priori likely: otherwise a prior of 5°/s
    would draw the rates of a flight at 30°/s towards zero.
    """
    rates, sds = prior.copy(), sd_prior.copy()
    compared = np.flatnonzero(is_near & is_wide)
    if len(compared) < _MIN_COMPARED:
        return rates, sds
    off2 = np.mean((near - wide)[compared] ** 2, axis=1)
    usual2 = float(np.mean(near[compared] ** 2))
    if off2.mean() < _MAX_UNLIKE**2 * usual2:
        sds = np.maximum(sds, math.sqrt(usual2))
    inner = np.flatnonzero(is_near)
    changes2 = np.mean(np.diff(near[compared], axis=0) ** 2, axis=1)
    usual_s = float(np.median(np.diff(time_s[inner])))
    for row in range(len(time_s)):
        # times ascend, so that the nearest frames are among as many on either side
        place = int(np.searchsorted(compared, row))
        around = np.arange(max(place - _MAX_COMPARED, 0), min(place + _MAX_COMPARED, len(compared)))
        order = np.argsort(np.abs(time_s[compared[around]] - time_s[row]), kind="stable")
        nearest = around[order[:_MAX_COMPARED]]
        shown_by = min(max(row, int(inner[0])), int(inner[-1]))
        error2 = off2[nearest]
        if shown_by != row:
            if abs(time_s[shown_by] - time_s[row]) > _MAX_INTERVALS * usual_s:
                continue
            error2 = changes2[np.minimum(nearest, len(changes2) - 1)]
        sd = math.hypot(math.sqrt(float(error2.mean())), vibration_share * sd_prior[row])
        rates[row], sds[row] = _weighted(near[shown_by], sd, prior[row], float(sds[row]))
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
