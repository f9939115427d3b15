"""Check of positions and calibration against each other, from all oriented frames of a flight.

In a single frame with few targets, the pose absorbs most of a wrong position or calibration. Frames
from other directions contradict it. Therefore corrections of all positions and of the calibration
are estimated from all frames, and compared with their standard deviations. So are two places of
each target, before and after any of its frames.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.frame_poses import NO_MOTIONS, SD_FOCAL, FramePose, point_images
from kgcp.network.ground.point_images import CameraMotion, PointImages
from kgcp.network.ground.pose_adjustment import (
    calibration_slopes,
    observations_by_calibration,
    position_equations,
)
from kgcp.network.ground.target_moves import FrameEquations, MovedTarget, moved_target

_DOUBTFUL_CHI2 = 16.3  # limit of three coordinates; chance exceeds it once in 1000 targets
_SAME_CHI2 = 13.8  # targets within this Δχ² of the worst one may be the wrong one instead
# Singular values below this share count as zero: the frames do not check such a direction.
_MIN_DETERMINED = 1e-6
_FREE_M = 100.0  # a-priori standard deviation of a position of which nothing is known
# Largest share of the squared residuals that is left where one wrong position explains why frames
# leave a target out. It is larger if, in some frames, another object was taken for the target.
_MAX_REST = 0.25
_MIN_SD_M = 1e-4  # lower limit of a position's standard deviation: no survey is better
_CHECKED = CALIBRATION_PARAMETERS[:5]  # fx, fy, cx, cy, k1: what frames together determine best
_WRONG_CAMERA_CHI2 = 20.5  # limit of five parameters; chance exceeds it once in 1000 flights
_MAX_OFF_SDS = 3.0  # by which a wrong calibration displaces cameras that are not reported
_NAMED_SDS = 4.0  # by which a parameter is off that is named
# A contradiction may be that of a camera in flight if it vanishes where this many times the stated
# motion is likely: 40°/s by default, or 20 m/s at 28 m.
_FASTER = 8.0
# A-priori standard deviations of a camera that may be any: of its lengths, as a share of the focal
# length, and of k1.
_CAMERA_SHARE_SD, _CAMERA_K1_SD = 0.1, 0.3


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


@dataclass(frozen=True, slots=True, eq=False)
class WrongCamera:
    """A calibration that the images contradict.

    Attributes
    ----------
    parameters : mapping of str to (float, float)
        Parameters that are wrong, with values and standard deviations that fit the images.
    off_m : float
        By how far the wrong calibration displaces a camera; the median.
    off_sds : float
        The same in stated standard deviations.
    """

    parameters: Mapping[str, tuple[float, float]]
    off_m: float
    off_sds: float


@dataclass(frozen=True, slots=True, eq=False)
class FastCamera:
    """A contradiction that a camera explains which moves faster than stated during the readout.

    Attributes
    ----------
    otherwise : WrongPosition or MovedTarget or WrongCamera
        What the frames contradict if it does not.
    """

    otherwise: WrongPosition | MovedTarget | WrongCamera


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of corrections to n positions and the calibration, from all frames."""

    names: Sequence[str]  # of the n targets
    normal: FloatArray  # (3 n + k, 3 n + k)
    right: FloatArray  # (3 n + k,)
    squares: float  # of the weighted residuals without corrections
    freedom: int
    prior_m2: FloatArray  # (3 n, 3 n): covariance of the positions
    oriented: Sequence[
        tuple[FramePose, PointImages, FloatArray]
    ]  # with `observations_by_calibration`
    frames: Sequence[FrameEquations]  # whose sum this is

    @property
    def positions(self) -> slice:
        return slice(len(self.prior_m2))

    def squares_without(self, count: int) -> float:
        """Return the weighted squares of the residuals if the first `count` unknowns are free."""
        normal, right = self.normal[:count, :count], self.right[:count]
        free = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
        return self.squares - float(free @ right)

    def noise_factor(self, count: int) -> float:
        """Return the factor of the images' variances if the first `count` unknowns are free."""
        return max(1.0, self.squares_without(count) / max(1, self.freedom - count))


def wrong_input(
    poses: Sequence[FramePose],
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    sd_scale: float,
    motions: Mapping[str, CameraMotion] = NO_MOTIONS,
) -> WrongPosition | MovedTarget | WrongCamera | FastCamera | None:
    """Return what the frames of a flight contradict most; None: nothing is doubtful.

    Parameters
    ----------
    poses : sequence of FramePose
        Result of `orient_frames` for the other arguments.
    """
    found = _contradiction(poses, sightings, positions, camera, sd_scale, motions)
    if found is None or not camera.readout_s:
        return found
    # frames that do not know their motion mostly share it, so that all contradict rest alike
    faster = replace(camera, motion_sd_deg_s=_FASTER * camera.motion_sd_deg_s)
    velocities = {frame: motion for frame, motion in motions.items() if motion.velocity is not None}
    is_explained = (
        len(velocities) < len(poses)
        and _contradiction(poses, sightings, positions, faster, sd_scale, velocities) is None
    )
    return FastCamera(found) if is_explained else found


def _contradiction(
    poses: Sequence[FramePose],
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    sd_scale: float,
    motions: Mapping[str, CameraMotion],
) -> WrongPosition | MovedTarget | WrongCamera | None:
    """Return what the frames contradict most by what is known of the camera's motion."""
    by_frame_and_target = {
        (each.frame, each.target): each for each in sightings if not each.instance
    }
    oriented = [pose for pose in _in_time(poses, sightings) if pose.residuals is not None]
    if not oriented:
        return None

    def equations(of_frames: Sequence[FramePose]) -> _Equations:
        return _equations(of_frames, by_frame_and_target, positions, camera, sd_scale, motions)

    agreeing = equations(oriented)
    position: WrongPosition | MovedTarget | None = _wrong_position(agreeing)
    # If most frames leave out a target, the one with the wrong position may be another, with which
    # too few targets are left to contradict it.
    disputed = equations(_with_disputed(oriented))
    wrong = _wrong_position(disputed) if disputed.oriented else None
    if wrong is not None and _explains_all(wrong, disputed):
        position = wrong
    # frames that show a target at its other place may have left it out
    everything = equations([replace(pose, used=pose.targets) for pose in oriented])
    moved = moved_target(
        everything.frames,
        everything.normal,
        everything.right,
        everything.squares,
        everything.freedom - len(everything.normal),
    )
    if moved and not (position and position.chi2 > moved.chi2):
        position = moved
    lens, chi2 = _wrong_camera(agreeing, camera)
    return lens if lens and not (position and position.chi2 > chi2) else position


def _with_disputed(oriented: Sequence[FramePose]) -> list[FramePose]:
    """Return the frames with targets that most of them left out; empty: there are none."""
    left_out = Counter(name for each in oriented for name in set(each.targets) - set(each.used))
    used = Counter(name for each in oriented for name in each.used)
    disputed = {name for name, count in left_out.items() if count > used[name]}
    names = [[n for n in each.targets if n in disputed or n in each.used] for each in oriented]
    changed = [replace(each, used=tuple(n)) for each, n in zip(oriented, names, strict=True)]
    return changed if disputed else []


def _in_time(poses: Sequence[FramePose], sightings: Sequence[Sighting]) -> Sequence[FramePose]:
    """Return the frames in the order in which they were taken, if their times are known."""
    time_s = {each.frame: each.time_s for each in sightings if each.time_s is not None}
    if any(pose.targets and pose.frame not in time_s for pose in poses):
        return poses
    return sorted(poses, key=lambda pose: time_s.get(pose.frame, 0.0))


def _wrong_position(equations: _Equations) -> WrongPosition | None:
    """Return the position that the frames contradict most; None: none is doubtful."""
    names, prior = equations.names, equations.prior_m2
    chi2, off_m = _by_position(equations, prior)
    worst = int(np.argmax(chi2))
    if chi2[worst] < _DOUBTFUL_CHI2:
        return None
    suspects = [row for row in np.argsort(-chi2) if chi2[worst] - chi2[row] < _SAME_CHI2]
    return WrongPosition(
        tuple(names[row] for row in suspects), float(off_m[worst]), float(chi2[worst])
    )


def _by_position(equations: _Equations, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return for each of n positions (n,) the decrease of χ² if it is left out, and its error [m].

    Parameters
    ----------
    prior : (3 n, 3 n) array
        Covariance of the positions [m²].
    """
    places = equations.positions
    normal, right = equations.normal[places, places], equations.right[places]
    # residuals that no corrections explain scale the noise of the images, but not the prior
    factor = equations.noise_factor(len(normal))
    gain = np.linalg.solve(np.eye(len(normal)) + prior @ (normal / factor), prior)
    corrections, correction_cov = gain @ right / factor, prior - gain
    chi2, off_m = [], []
    for row in range(len(equations.names)):
        at = slice(3 * row, 3 * row + 3)
        solved = np.linalg.lstsq(correction_cov[at, at], corrections[at], rcond=_MIN_DETERMINED)[0]
        chi2.append(float(corrections[at] @ solved))
        off_m.append(float(np.linalg.norm(prior[at, at] @ solved)))
    return np.array(chi2), np.array(off_m)


def _explains_all(wrong: WrongPosition, equations: _Equations) -> bool:
    """Tell whether images and other positions agree once a wrong position is free."""
    prior = equations.prior_m2.copy()
    first = 3 * equations.names.index(wrong.targets[0])
    prior[range(first, first + 3), range(first, first + 3)] += _FREE_M**2
    chi2, _ = _by_position(equations, prior)
    others = np.delete(chi2, first // 3)
    rest = equations.squares_without(len(prior))
    return rest < _MAX_REST * equations.squares and bool(np.all(others < _DOUBTFUL_CHI2))


def _wrong_camera(equations: _Equations, camera: Camera) -> tuple[WrongCamera | None, float]:
    """Return the calibration's error if it matters, and the decrease of χ² by correcting it."""
    count, prior = len(equations.normal), equations.prior_m2
    is_focal_free = any(pose.sd_focal_scale is not None for pose, *_ in equations.oriented)
    if is_focal_free or equations.freedom <= count:
        return None, 0.0
    factor = equations.noise_factor(count)
    normal, right = equations.normal / factor, equations.right / factor
    # corrections of the positions, with their a-priori covariance, are eliminated
    places, lens = equations.positions, slice(len(prior), None)
    gain = np.linalg.solve(np.eye(len(prior)) + prior @ normal[places, places], prior)
    by_places = normal[lens, places] @ gain
    lengths = _CAMERA_SHARE_SD * camera.mean_focal_px
    sds = [_CAMERA_K1_SD if name == "k1" else lengths for name in _CHECKED]
    before = np.diag(np.array(sds) ** -2.0)
    cov = np.linalg.inv(normal[lens, lens] - by_places @ normal[places, lens] + before)
    rest = right[lens] - by_places @ right[places]
    corrections = cov @ rest
    chi2 = float(rest @ corrections)
    if chi2 < _WRONG_CAMERA_CHI2:
        return None, chi2
    off_m, off_sds = [], []
    for pose, images, by_calibration in equations.oriented:
        if pose.pose is None or pose.cov is None:
            continue
        slopes = calibration_slopes(camera, images, pose.pose, by_calibration)[:3]
        off = slopes @ corrections
        # what the frames determine badly counts less
        off_cov = pose.cov[:3, :3] + slopes @ cov @ slopes.T
        off_m.append(float(np.linalg.norm(off)))
        off_sds.append(math.sqrt(float(off @ np.linalg.solve(off_cov, off))))
    if not np.median(off_sds) > _MAX_OFF_SDS:
        return None, chi2
    found_sds = np.sqrt(np.diag(cov))
    parameters = {
        name: (getattr(camera, name) + float(correction), float(sd))
        for name, correction, sd in zip(_CHECKED, corrections, found_sds, strict=True)
        if abs(correction) > _NAMED_SDS * sd
    }
    return WrongCamera(parameters, float(np.median(off_m)), float(np.median(off_sds))), chi2


def _equations(
    poses: Sequence[FramePose],
    by_frame_and_target: Mapping[tuple[str, str], Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    sd_scale: float,
    motions: Mapping[str, CameraMotion],
) -> _Equations:
    names = list(dict.fromkeys(name for pose in poses for name in pose.used))
    count = 3 * len(names) + len(_CHECKED)
    normal, right = np.zeros((count, count)), np.zeros(count)
    squares, freedom = 0.0, 0
    oriented, frames = [], []
    for pose in poses:
        if pose.pose is None:
            continue
        used = pose.used
        sightings = [by_frame_and_target[pose.frame, name] for name in used]
        images = point_images(sightings, positions, sd_scale, camera, motions.get(pose.frame))
        has_free_focal = pose.sd_focal_scale is not None
        by_calibration = observations_by_calibration(camera, sightings, len(_CHECKED))
        equations = position_equations(
            camera, images, pose.pose, SD_FOCAL * has_free_focal, by_calibration
        )
        if equations is None:
            continue
        of_points = np.ravel([3 * names.index(name) + np.arange(3) for name in used])
        at = np.concatenate((of_points, np.arange(3 * len(names), count)))
        normal[np.ix_(at, at)] += equations[0]
        right[at] += equations[1]
        squares += equations[2]
        freedom += 2 * len(used) + int(np.count_nonzero(images.has_distance)) - 6 - has_free_focal
        oriented.append((pose, images, by_calibration))
        frames.append(FrameEquations(pose.frame, used, at, *equations[:2]))
    prior = np.zeros((3 * len(names), 3 * len(names)))
    for row, name in enumerate(names):
        cov = positions[name].cov_m2
        position_cov = _MIN_SD_M**2 * np.eye(3) + (0.0 if cov is None else cov)
        prior[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = position_cov
    return _Equations(names, normal, right, squares, freedom, prior, oriented, frames)
