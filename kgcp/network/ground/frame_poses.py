"""Orientation of a flight's frames by the static targets in them.

Three or more targets give a pose by resection. A single ring gives one if the attitude of its plate
is known, namely from frames with three targets. Such a pose is much weaker, because the direction
of view relative to the plate follows from one image of a circle. If the two poses of the circle
cannot be distinguished, there is none.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix, place_covariances
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.point_images import CameraMotion, CameraPose, PointImages, Readout
from kgcp.network.ground.pose_adjustment import position_slopes
from kgcp.network.ground.resection import MIN_MARGIN, MIN_POINTS, NoPoseError, Resection, orient
from kgcp.targets.plain import AnyTarget

FOCAL_SCALES = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0)
"""Start values of an unknown focal length, as multiples of the camera's."""

SD_FOCAL = 0.7
"""A-priori standard deviation of the logarithm of an unknown focal length: a factor of two."""
FOCAL_DETERMINED = 0.05
"""Largest relative standard deviation of a focal length that counts as determined."""

NO_MOTIONS: Mapping[str, CameraMotion] = MappingProxyType({})
"""Nothing is known of any frame's motion during the readout."""

UNSTATED_SCALE_SD = 0.005
"""Standard deviation of the logarithm of all distances' common scale, if the accuracy of the
targets' prints is not stated."""

_MAX_SCALE_SIGMAS = 4.0  # largest common scale of the distances, in standard deviations
_MIN_PLATE_FRAMES = 3  # frames from which the attitude of a plate is estimated
_MIN_ATTITUDE_SD_RAD = 1e-5  # added to the standard deviation of a plate's attitude by one frame
_AGREEING_CHI2 = 25.0  # limit of the χ² of a target's three coordinates


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """The orientation of one frame, or the reason why there is none.

    Attributes
    ----------
    frame : str
    targets : tuple of str
        Static targets that were measured in it.
    pose : CameraPose or None
        In the local ENU frame; None: not oriented.
    cov : (6, 6) array or None
        Position [m] and left rotation vector [rad], ENU axes.
    used : tuple of str
        Targets that agree with the pose.
    reason : str
        Why the frame was not oriented; empty: it was.
    is_by_one_ring : bool
        Whether the pose comes from one ring, with the plate's attitude from other frames.
    margin : float or None
        Δχ² by which the next best pose fits worse; None: there is no other.
    variance_factor : float or None
        χ² per degree of freedom; None: no redundancy.
    sd_focal_scale : float or None
        Relative standard deviation of the focal length; None: it was known.
    residuals : (n, 3) array or None
        Observed minus computed places of the targets [px], and logarithms of their distances (NaN:
        not measured); None: the pose is not from three targets or more.
    chi2 : (n,) array or None
        Squared residuals of each target over their covariance; None as for `residuals`.
    distance_scale : float or None
        Logarithm of the common factor by which all distances are too long; None as for
        `residuals`.
    sd_distance_scale : float or None
        Its standard deviation.
    by_positions : (6, m, 3) array or None
        Derivatives of the pose by the positions of the m used targets; None as for `residuals`.
    """

    frame: str
    targets: tuple[str, ...]
    pose: CameraPose | None
    cov: FloatArray | None
    used: tuple[str, ...]
    reason: str
    is_by_one_ring: bool = False
    margin: float | None = None
    variance_factor: float | None = None
    sd_focal_scale: float | None = None
    residuals: FloatArray | None = None
    chi2: FloatArray | None = None
    distance_scale: float | None = None
    sd_distance_scale: float | None = None
    by_positions: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlateAttitude:
    """Attitude of a static plate."""

    enu_from_plate: FloatArray  # (3, 3): its axes in the ENU frame, as columns
    cov: FloatArray  # (3, 3): of a left rotation vector, ENU axes [rad²]


def print_scale_sd(targets: Iterable[AnyTarget]) -> float:
    """Return `sd_scale` for `orient_frames` from the stated accuracy of targets' prints.

    It is the largest relative standard deviation of a diameter.
    """
    shares = [target.sd_outer_diameter_m / target.outer_diameter_m for target in targets]
    return max(shares, default=0.0) if all(shares) else UNSTATED_SCALE_SD


def orient_frames(
    frames: Sequence[str],
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    *,
    min_points: int = MIN_POINTS,
    has_free_focal: bool = False,
    sd_scale: float = UNSTATED_SCALE_SD,
    motions: Mapping[str, CameraMotion] = NO_MOTIONS,
) -> list[FramePose]:
    """Orient frames by their static targets, at the moment of the middle row.

    Parameters
    ----------
    frames : sequence of str
        Frames to orient.
    sightings : sequence of Sighting
        Sightings of static targets; those in frames with several plates of a code are left out.
    positions : mapping of str to TargetPosition
        Positions of the static targets in the ENU frame.
    min_points : int
        Number of targets that must agree; three are enough if their distances are known.
    has_free_focal : bool
        Whether the focal length is unknown, to a factor of two.
    sd_scale : float
        Standard deviation of the logarithm of all distances' common scale, as the prints cause it:
        see `print_scale_sd`. The sightings state a common error, too, which includes print and
        calibration. The larger of the two counts.
    motions : mapping of str to CameraMotion
        What is known of the camera's motion during the readout, by frame.
    """
    by_frame: dict[str, list[Sighting]] = {frame: [] for frame in frames}
    static = [each for each in sightings if each.frame in by_frame and each.target in positions]
    for each in unmistakable(static):
        by_frame[each.frame].append(each)
    several = Counter(
        frame for frame, _ in {(each.frame, each.target) for each in static if each.instance}
    )
    poses = []
    for frame, in_frame in by_frame.items():
        usable = [each for each in in_frame if each.centre_cov_px2 is not None]
        names = tuple(each.target for each in usable)
        if len(usable) < 3:
            reason = _count_words(len(usable), several[frame])
            poses.append(FramePose(frame, names, None, None, (), reason))
            continue
        images = point_images(usable, positions, sd_scale, camera, motions.get(frame))
        poses.append(
            _by_points(frame, names, images, camera, min_points, has_free_focal=has_free_focal)
        )
    if has_free_focal:
        return poses
    plates = _plate_attitudes(poses, by_frame, positions, camera, motions)
    return [
        _by_ring(
            pose,
            by_frame[pose.frame],
            positions,
            plates,
            sd_scale,
            camera,
            motions.get(pose.frame),
        )
        if pose.pose is None and pose.targets
        else pose
        for pose in poses
    ]


def point_images(
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    sd_scale: float,
    camera: Camera,
    motion: CameraMotion | None,
) -> PointImages:
    """Return a frame's measured targets as points of known position.

    Parameters
    ----------
    sd_scale : float
        As for `orient_frames`.
    motion : CameraMotion or None
        As for `Readout.of`.
    """
    no_cov = np.zeros((3, 3))
    places = [positions[each.target] for each in sightings]
    # errors of prints may be independent or common to all targets: both are allowed for
    sds = [
        math.nan
        if each.sd_distance_m is None
        else math.hypot(each.sd_distance_m, each.sd_common_distance_m or 0.0)
        for each in sightings
    ]
    known = np.isfinite(sds)
    pixels = np.array([each.centre_px for each in sightings])
    return PointImages(
        np.array([place.position_m for place in places]),
        np.array([no_cov if place.cov_m2 is None else place.cov_m2 for place in places]),
        pixels,
        np.array([each.centre_cov_px2 for each in sightings]),
        np.where(known, [each.distance_m for each in sightings], np.nan),
        np.array(sds),
        max(sd_scale, float(np.median([_common_share(each) for each in sightings]))),
        Readout.of(camera, pixels, motion),
    )


def _common_share(sighting: Sighting) -> float:
    """Return the relative standard deviation of a sighting's distance that all frames share."""
    return (sighting.sd_common_distance_m or 0.0) / sighting.distance_m


def _by_points(
    frame: str,
    names: tuple[str, ...],
    images: PointImages,
    camera: Camera,
    min_points: int,
    *,
    has_free_focal: bool,
) -> FramePose:
    """Orient a frame by three or more targets, or return the reason why this fails."""
    focals, sd_focal_before = (FOCAL_SCALES, SD_FOCAL) if has_free_focal else ((1.0,), 0.0)

    def resected(points: PointImages) -> Resection:
        return orient(
            camera, points, min_points=min_points, focals=focals, sd_focal=sd_focal_before
        )

    try:
        resection = resected(images)
    except NoPoseError as error:
        reason = _scale_reason(names, images, resected) or str(error)
        return FramePose(frame, names, None, None, (), reason)
    if abs(resection.distance_scale) > _MAX_SCALE_SIGMAS * images.sd_scale:
        return FramePose(frame, names, None, None, (), _scale_words(resection.distance_scale))
    sd_focal = math.sqrt(resection.cov[6, 6]) if has_free_focal else None
    if sd_focal is not None and sd_focal > FOCAL_DETERMINED:
        reason = f"the focal length is not determined (± {100.0 * sd_focal:.0f} %)"
        return FramePose(frame, names, None, None, (), reason)
    return _of_resection(frame, names, resection, sd_focal, images, camera, sd_focal_before)


def _scale_reason(
    names: Sequence[str], images: PointImages, resected: Callable[[PointImages], Resection]
) -> str:
    """Return the reason that distances have a wrong scale, or an empty string.

    It applies if a pose without the distances exists, and they differ from it by a common factor,
    or less than half of them differ from it while the others agree.
    """
    unknown = np.full(len(images), np.nan)
    with contextlib.suppress(NoPoseError):
        resection = resected(replace(images, distances_m=unknown, sd_distances_m=unknown))
        if len(resection.cov) > 6 and math.sqrt(resection.cov[6, 6]) > FOCAL_DETERMINED:
            return ""
        true_m = np.linalg.norm(resection.pose.in_camera(images.positions_m), axis=1)
        logs = np.log(images.distances_m * resection.pose.focal_scale / true_m)
        scale, limit = float(np.nanmedian(logs)), _MAX_SCALE_SIGMAS * images.sd_scale
        if abs(scale) > limit > np.nanmedian(np.abs(logs - scale)):
            return _scale_words(scale)
        is_wrong = np.abs(logs) > limit
        if abs(scale) < limit and is_wrong.any():
            wrong = ", ".join(name for name, off in zip(names, is_wrong, strict=True) if off)
            return f"the distance of {wrong} contradicts the others; look at the diameter"
    return ""


def _scale_words(scale: float) -> str:
    """Return the reason for a wrong scale of all distances; rounded, so that frames share it."""
    share = math.exp(scale) - 1.0
    size = abs(share)
    words = f"{100.0 * size:.0f} %" if size >= 0.01 else f"{1000.0 * size:.0f} ‰"
    return (
        f"the distances are {words} {'longer' if share > 0.0 else 'shorter'} than the positions"
        " say; look at the targets' diameters and at the focal length"
    )


def _of_resection(
    frame: str,
    names: tuple[str, ...],
    resection: Resection,
    sd_focal: float | None,
    images: PointImages,
    camera: Camera,
    sd_focal_before: float,
) -> FramePose:
    """Return the frame's pose by a resection, with the standard deviation of the distance scale."""
    # with a free common scale, images and positions alone determine the distance: its standard
    # deviation along the line of sight is that of the scale
    sight = images.positions_m[resection.is_used].mean(axis=0) - resection.pose.centre_m
    sd_scale = math.sqrt(float(sight @ resection.cov[:3, :3] @ sight)) / float(sight @ sight)
    return FramePose(
        frame=frame,
        targets=names,
        pose=resection.pose,
        cov=resection.cov[:6, :6],
        used=tuple(name for name, used in zip(names, resection.is_used, strict=True) if used),
        reason="",
        margin=None if math.isinf(resection.margin) else resection.margin,
        variance_factor=resection.variance_factor,
        sd_focal_scale=sd_focal,
        residuals=resection.residuals,
        chi2=resection.chi2,
        distance_scale=resection.distance_scale,
        sd_distance_scale=sd_scale,
        by_positions=position_slopes(
            camera, images.chosen(resection.is_used), resection.pose, sd_focal_before
        )[:6],
    )


def _count_words(count: int, several: int) -> str:
    words = "no static target" if count == 0 else f"{count} static target{'s' * (count > 1)}"
    besides = f", besides {several} whose code several plates have"
    return words + besides * (several > 0)


@dataclass(frozen=True, slots=True, eq=False)
class _AttitudeSample:
    """Attitude of a plate by one frame that its targets orient."""

    enu_from_plate: FloatArray  # (3, 3)
    cov: FloatArray  # (3, 3): of errors that differ between frames, as in `PlateAttitude`
    by_positions: Mapping[str, FloatArray]  # (3, 3): derivatives by the positions of the targets


def _plate_attitudes(
    poses: Sequence[FramePose],
    by_frame: Mapping[str, Sequence[Sighting]],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    motions: Mapping[str, CameraMotion],
) -> dict[str, PlateAttitude]:
    """Return the attitudes of plates, from frames that are oriented by three or more targets."""
    position_covs = {name: place.cov_m2 for name, place in positions.items()}
    samples: dict[str, list[_AttitudeSample]] = {}
    for pose in poses:
        for each in by_frame[pose.frame]:
            if each.target in pose.used and _is_unambiguous(each):
                motion = motions.get(pose.frame)
                sample = _attitude_sample(pose, each, position_covs, camera, motion)
                if sample is not None:
                    samples.setdefault(each.target, []).append(sample)
    return {
        target: _mean_attitude(of_target, position_covs)
        for target, of_target in samples.items()
        if len(of_target) >= _MIN_PLATE_FRAMES
    }


def _attitude_sample(
    frame: FramePose,
    ring: Sighting,
    position_covs: Mapping[str, FloatArray | None],
    camera: Camera,
    motion: CameraMotion | None,
) -> _AttitudeSample | None:
    """Return the attitude of a ring's plate by a frame; None if a pose or covariance is missing."""
    if frame.pose is None or frame.cov is None or frame.by_positions is None:
        return None
    if ring.pose is None or ring.pose_cov is None:
        return None
    world_from_camera = frame.pose.world_from_camera
    slopes = np.swapaxes(frame.by_positions[3:], 0, 1)
    by_positions = dict(zip(frame.used, slopes, strict=True))
    cov = frame.cov[3:, 3:] - _rotation_cov(by_positions, position_covs)
    cov = cov + world_from_camera @ ring.pose_cov[3:, 3:] @ world_from_camera.T
    readout = Readout.of(camera, ring.centre_px[None], motion)
    if readout is not None:
        rotation_vector, sd_rad = _rotation_until_row(frame.pose, readout)
        world_from_camera = rotation_about(rotation_vector) @ world_from_camera
        cov = cov + sd_rad**2 * np.eye(3)
    return _AttitudeSample(world_from_camera @ ring.pose.rotation, cov, by_positions)


def _rotation_cov(
    slopes: Mapping[str, FloatArray], position_covs: Mapping[str, FloatArray | None]
) -> FloatArray:
    """Return the covariance (3, 3) of a rotation that errors of the positions cause."""
    total = np.zeros((3, 3))
    for name, slope in slopes.items():
        position_cov = position_covs[name]
        if position_cov is not None:
            total += slope @ position_cov @ slope.T
    return total


def _mean_attitude(
    samples: Sequence[_AttitudeSample], position_covs: Mapping[str, FloatArray | None]
) -> PlateAttitude:
    """Return the mean attitude of samples, without outliers.

    If the samples scatter more than stated, the covariance is enlarged accordingly. Errors of the
    targets' positions are common to all samples, so that averaging does not reduce them.
    """
    attitudes = np.array([sample.enu_from_plate for sample in samples])
    middle = Rotation.from_matrix(attitudes).mean().as_matrix()
    for _ in range(3):
        residuals = Rotation.from_matrix(attitudes @ middle.T).as_rotvec()
        size = np.linalg.norm(residuals, axis=1)
        kept = size <= 4.0 * max(float(np.median(size)), 1e-6)
        middle = Rotation.from_matrix(attitudes[kept]).mean().as_matrix()
    residuals = Rotation.from_matrix(attitudes[kept] @ middle.T).as_rotvec()
    covs = np.array([sample.cov for sample in samples])[kept] + _MIN_ATTITUDE_SD_RAD**2 * np.eye(3)
    slopes = {name: np.zeros((3, 3)) for name in position_covs}
    for sample, is_kept in zip(samples, kept, strict=True):
        for name, slope in sample.by_positions.items():
            slopes[name] += is_kept * slope / len(residuals)
    common_cov = _rotation_cov(slopes, position_covs)
    chi2 = float(np.sum(residuals * np.linalg.solve(covs, residuals[..., None])[..., 0]))
    factor = max(1.0, chi2 / (3.0 * max(1, len(residuals) - 1)))
    return PlateAttitude(middle, factor * covs.sum(axis=0) / len(residuals) ** 2 + common_cov)


def _is_unambiguous(sighting: Sighting) -> bool:
    """Tell whether the heading of a ring is known and one of its two poses fits much better."""
    is_clear = sighting.ambiguity is None or sighting.ambiguity >= MIN_MARGIN
    return sighting.has_heading and is_clear


def _by_ring(
    failed: FramePose,
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    plates: Mapping[str, PlateAttitude],
    sd_scale: float,
    camera: Camera,
    motion: CameraMotion | None,
) -> FramePose:
    """Return the pose by the best of a frame's rings, or the frame unchanged if there is none.

    The ring may have a wrong name. Therefore most other targets in the frame must be where its
    pose puts them.
    """
    options = []
    for each in sightings:
        if each.target not in plates or not _is_unambiguous(each):
            continue
        at_row = _pose_by_ring(each, positions[each.target], plates[each.target], sd_scale)
        if at_row is None:
            continue
        readout = Readout.of(camera, each.centre_px[None], motion)
        pose, cov = at_row if readout is None else _at_middle_row(*at_row, readout, each.distance_m)
        agreeing = [
            _agrees(other, positions[other.target], pose, cov)
            for other in sightings
            if other is not each
        ]
        decided = [agrees for agrees in agreeing if agrees is not None]
        if not decided or 2 * sum(decided) > len(decided):
            options.append((float(np.trace(cov[:3, :3])), each, pose, cov))
    if not options:
        return failed
    _, ring, pose, cov = min(options, key=lambda option: option[0])
    return FramePose(
        frame=failed.frame,
        targets=failed.targets,
        pose=pose,
        cov=cov,
        used=(ring.target,),
        reason="",
        is_by_one_ring=True,
        margin=ring.ambiguity,
    )


def _at_middle_row(
    pose: CameraPose, cov: FloatArray, readout: Readout, distance_m: float
) -> tuple[CameraPose, FloatArray]:
    """Return pose and covariance at the middle row, from those at the row of one point."""
    rotation_vector, sd_rad = _rotation_until_row(pose, readout)
    delay_s = float(readout.delay_s[0])
    velocity = readout.velocity(distance_m)
    by_motion = np.repeat([velocity.sd_m_s * abs(delay_s), sd_rad], 3) ** 2
    until_row = np.concatenate((delay_s * velocity.velocity_m_s, rotation_vector))
    return pose.moved(-until_row), cov + np.diag(by_motion)


def _rotation_until_row(pose: CameraPose, readout: Readout) -> tuple[FloatArray, float]:
    """Return the rotation vector (3,) of the camera from the middle row to that of one point.

    It is in world axes [rad]; its standard deviation per axis follows. The camera rotates opposite
    to the scene.
    """
    delay_s = float(readout.delay_s[0])
    rotation_vector = (
        -delay_s * pose.world_from_camera @ np.array(readout.motion.rotation.velocity_rad_s)
    )
    return rotation_vector, readout.motion.rotation.sd_rad_s * abs(delay_s)


def _agrees(
    sighting: Sighting, place: TargetPosition, pose: CameraPose, cov: FloatArray
) -> bool | None:
    """Tell whether a frame's pose puts a measured target at its position.

    None: the target has no pose or no covariance.
    """
    if sighting.pose is None or sighting.pose_cov is None:
        return None
    rotation, sight = pose.world_from_camera, pose.world_from_camera @ sighting.pose.translation_m
    residual_m = pose.centre_m + sight - place.position_m
    target_cov = sighting.pose_cov
    if sighting.common_pose_cov is not None:
        target_cov = target_cov + sighting.common_pose_cov
    total = place_covariances(cov, sight) + rotation @ target_cov[:3, :3] @ rotation.T
    if place.cov_m2 is not None:
        total = total + place.cov_m2
    return bool(residual_m @ np.linalg.solve(total, residual_m) < _AGREEING_CHI2)


def _pose_by_ring(
    ring: Sighting, place: TargetPosition, plate: PlateAttitude, sd_scale: float
) -> tuple[CameraPose, FloatArray] | None:
    """Return the camera's pose and covariance by one ring; None if the ring lacks either.

    The camera's rotation is R = W Mᵀ and its position C = X − R t, with the rotation W of the
    plate, the measured rotation M and centre t, and the position X. To first order, an error α of
    the plate's rotation, errors δ and τ of the measured rotation and centre, and an error ρ of the
    position cause the errors α − R δ of the rotation and ρ − α × R t − R (τ + t × δ) of C.
    """
    if ring.pose is None or ring.pose_cov is None:
        return None
    rotation = plate.enu_from_plate @ ring.pose.rotation.T
    sight = rotation @ ring.pose.translation_m
    common = ring.common_pose_cov
    pose_cov = ring.pose_cov if common is None else ring.pose_cov + common
    from_pose = np.block(
        [
            [-rotation, -rotation @ cross_matrix(ring.pose.translation_m)],
            [np.zeros((3, 3)), -rotation],
        ]
    )
    from_plate = np.vstack((cross_matrix(sight), np.eye(3)))
    cov = from_pose @ pose_cov @ from_pose.T + from_plate @ plate.cov @ from_plate.T
    # the part of the scale's variance that the ring's own common error does not include
    cov[:3, :3] += max(0.0, sd_scale**2 - _common_share(ring) ** 2) * np.outer(sight, sight)
    if place.cov_m2 is not None:
        cov[:3, :3] += place.cov_m2
    return CameraPose(place.position_m - sight, rotation), np.asarray(cov)
