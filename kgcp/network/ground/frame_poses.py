"""Frames of a flight oriented by the static targets in them.

Three targets or more give a pose by resection. A single ring gives one as well, once it is known
how its plate lies: the frames with three targets tell that. Its normal then comes from its image
alone, so that such a pose is much weaker, and none if the circle's two poses cannot be told apart.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.network.ground.point_images import CameraPose, PointImages, Readout
from kgcp.network.ground.pose_adjustment import position_slopes
from kgcp.network.ground.resection import MIN_MARGIN, MIN_POINTS, NoPoseError, Resection, orient
from kgcp.targets.plain import AnyTarget

FOCAL_SCALES = (0.5, 0.63, 0.8, 1.0, 1.25, 1.6, 2.0)
"""Starts for an unknown focal length, as multiples of the camera's."""

SD_FOCAL = 0.7
"""Of the logarithm of such a focal length: a factor of two."""
FOCAL_DETERMINED = 0.05
"""Relative standard deviation of a focal length that is determined, at most."""

NO_ROTATIONS: Mapping[str, SceneRotation] = MappingProxyType({})
"""For frames of which nothing is known of the motion during the readout."""

UNSTATED_SCALE_SD = 0.005
"""Of the logarithm of all distances together, where nobody says how well targets are printed."""

_MOST_SCALE_SD = 4.0  # standard deviations that all distances may be off by, alike
_LEAST_PLATE_FRAMES = 3  # that tell how a plate lies
_LEAST_TURN_RAD = 1e-5  # of the deviation of how it lies by one of them
_AGREEING_CHI2 = 25.0  # of three coordinates, at most


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """What became of one frame.

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
        Targets that agree with it.
    reason : str
        Why it was not oriented; empty: it was.
    is_by_one_ring : bool
        Whether the pose comes from one ring, with the plate's attitude from other frames.
    margin : float or None
        Δχ² by which the next best pose fits worse; None: there is no other.
    variance_factor : float or None
        Squares of the residuals per degree of freedom; None: there is none.
    sd_focal_scale : float or None
        Relative standard deviation of the focal length; None: it was known.
    residuals : (n, 3) array or None
        Observed minus computed places of the targets [px], and logarithms of their distances, NaN
        where they are not known; None: not by three targets.
    chi2 : (n,) array or None
        Their squares over their covariances.
    distance_scale : float or None
        Logarithm of what all distances are too long by, alike; None: as `residuals`.
    sd_distance_scale : float or None
        Its standard deviation.
    by_positions : (6, m, 3) array or None
        Derivatives of the pose by the positions of the m used targets; None: as `residuals`.
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
    """How a static plate lies."""

    enu_from_plate: FloatArray  # (3, 3): its axes in the ENU frame, as columns
    cov: FloatArray  # (3, 3): of a left rotation vector, ENU axes [rad²]


def print_scale_sd(targets: Iterable[AnyTarget]) -> float:
    """Return `sd_scale` of `orient_frames`: how well the static targets are printed, as stated.

    That of the least well known one, as a share of its diameter.
    """
    static = [target for target in targets if target.position_m is not None]
    shares = [target.sd_outer_diameter_m / target.outer_diameter_m for target in static]
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
    rotations: Mapping[str, SceneRotation] = NO_ROTATIONS,
) -> list[FramePose]:
    """Orient frames by their static targets, at the moment of the middle row.

    Parameters
    ----------
    frames : sequence of str
        That are to be oriented.
    sightings : sequence of Sighting
        Of static targets; second plates with one code are passed over.
    positions : mapping of str to TargetPosition
        Of the static targets, in the ENU frame.
    min_points : int
        Targets that must agree where their distances are not known; three that are.
    has_free_focal : bool
        Whether the focal length is unknown, to a factor of two.
    sd_scale : float
        Of the logarithm of what all distances may be off by, alike, by their prints: see
        `print_scale_sd`. The common share that the sightings state has what was stated of their
        prints in it, and the calibration: the larger one of the two counts.
    rotations : mapping of str to SceneRotation
        How the scene turns while frames are read, as far as it is known, by their names.
    """
    by_frame: dict[str, list[Sighting]] = {frame: [] for frame in frames}
    for each in sightings:
        if each.frame in by_frame and each.target in positions and not each.instance:
            by_frame[each.frame].append(each)
    poses = []
    for frame, mine in by_frame.items():
        usable = [each for each in mine if each.centre_cov_px2 is not None]
        names = tuple(each.target for each in usable)
        if len(usable) < 3:
            poses.append(FramePose(frame, names, None, None, (), _count_words(len(usable))))
            continue
        images = point_images(usable, positions, sd_scale, camera, rotations.get(frame))
        poses.append(
            _by_points(frame, names, images, camera, min_points, has_free_focal=has_free_focal)
        )
    if has_free_focal:
        return poses
    plates = _plate_attitudes(poses, by_frame, positions, camera, rotations)
    return [
        _by_ring(
            pose,
            by_frame[pose.frame],
            positions,
            plates,
            sd_scale,
            camera,
            rotations.get(pose.frame),
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
    rotation: SceneRotation | None,
) -> PointImages:
    """Return a frame's measured targets as points of known position.

    Parameters
    ----------
    sd_scale : float
        As for `orient_frames`.
    rotation : SceneRotation or None
        As for `Readout.of`.
    """
    no_cov = np.zeros((3, 3))
    places = [positions[each.target] for each in sightings]
    # a print may be wrong by itself, or as those of all targets are: both are allowed for
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
        Readout.of(camera, pixels, rotation),
    )


def _common_share(sighting: Sighting) -> float:
    """Return what a sighting states that its distance may be off by in all frames, as a share."""
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
    """Orient a frame by three targets or more; where that fails, give the reason."""
    focals, sd_focal_before = (FOCAL_SCALES, SD_FOCAL) if has_free_focal else ((1.0,), 0.0)

    def resected(points: PointImages) -> Resection:
        return orient(
            camera, points, min_points=min_points, focals=focals, sd_focal=sd_focal_before
        )

    try:
        found = resected(images)
    except NoPoseError as error:
        reason = _scale_reason(images, resected) or str(error)
        return FramePose(frame, names, None, None, (), reason)
    if abs(found.distance_scale) > _MOST_SCALE_SD * images.sd_scale:
        return FramePose(frame, names, None, None, (), _scale_words(found.distance_scale))
    sd_focal = math.sqrt(found.cov[6, 6]) if has_free_focal else None
    if sd_focal is not None and sd_focal > FOCAL_DETERMINED:
        reason = f"the focal length is not determined (± {100.0 * sd_focal:.0f} %)"
        return FramePose(frame, names, None, None, (), reason)
    return _of_resection(frame, names, found, sd_focal, images, camera, sd_focal_before)


def _scale_reason(images: PointImages, resected: Callable[[PointImages], Resection]) -> str:
    """Return that all distances are wrong alike, if points fit well without them; else nothing."""
    unknown = np.full(len(images), np.nan)
    with contextlib.suppress(NoPoseError):
        found = resected(replace(images, distances_m=unknown, sd_distances_m=unknown))
        if len(found.cov) > 6 and math.sqrt(found.cov[6, 6]) > FOCAL_DETERMINED:
            return ""
        true_m = np.linalg.norm(found.pose.in_camera(images.positions_m), axis=1)
        logs = np.log(images.distances_m * found.pose.focal_scale / true_m)
        scale, limit = float(np.nanmedian(logs)), _MOST_SCALE_SD * images.sd_scale
        if abs(scale) > limit > np.nanmedian(np.abs(logs - scale)):
            return _scale_words(scale)
    return ""


def _scale_words(scale: float) -> str:
    """Return the reason by which all distances are wrong, in whole numbers to group frames."""
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
    found: Resection,
    sd_focal: float | None,
    images: PointImages,
    camera: Camera,
    sd_focal_before: float,
) -> FramePose:
    """Return a resection with the deviation of what all distances have in common."""
    # where all distances are off alike, images and positions alone tell how far away they are
    sight = images.positions_m[found.is_used].mean(axis=0) - found.pose.centre_m
    sd_scale = math.sqrt(float(sight @ found.cov[:3, :3] @ sight)) / float(sight @ sight)
    return FramePose(
        frame=frame,
        targets=names,
        pose=found.pose,
        cov=found.cov[:6, :6],
        used=tuple(name for name, used in zip(names, found.is_used, strict=True) if used),
        reason="",
        margin=None if math.isinf(found.margin) else found.margin,
        variance_factor=found.variance_factor,
        sd_focal_scale=sd_focal,
        residuals=found.residuals,
        chi2=found.chi2,
        distance_scale=found.distance_scale,
        sd_distance_scale=sd_scale,
        by_positions=position_slopes(
            camera, images.chosen(found.is_used), found.pose, sd_focal_before
        )[:6],
    )


def _count_words(count: int) -> str:
    return "no static target" if count == 0 else f"{count} static target{'s' * (count > 1)}"


@dataclass(frozen=True, slots=True, eq=False)
class _AttitudeSample:
    """How a plate lies, by one frame that other targets orient."""

    enu_from_plate: FloatArray  # (3, 3)
    cov: FloatArray  # (3, 3): what differs between frames, as in `PlateAttitude`
    by_positions: Mapping[str, FloatArray]  # (3, 3): its turn by the other targets' positions


def _plate_attitudes(
    poses: Sequence[FramePose],
    by_frame: Mapping[str, Sequence[Sighting]],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
    rotations: Mapping[str, SceneRotation],
) -> dict[str, PlateAttitude]:
    """Return how plates lie, by the frames that were oriented without them being needed."""
    position_covs = {name: place.cov_m2 for name, place in positions.items()}
    samples: dict[str, list[_AttitudeSample]] = {}
    for pose in poses:
        for each in by_frame[pose.frame]:
            if each.target in pose.used and _is_told_apart(each):
                rotation = rotations.get(pose.frame)
                sample = _attitude_sample(pose, each, position_covs, camera, rotation)
                if sample is not None:
                    samples.setdefault(each.target, []).append(sample)
    return {
        target: _mean_attitude(of_target, position_covs)
        for target, of_target in samples.items()
        if len(of_target) >= _LEAST_PLATE_FRAMES
    }


def _attitude_sample(
    frame: FramePose,
    ring: Sighting,
    position_covs: Mapping[str, FloatArray | None],
    camera: Camera,
    rotation: SceneRotation | None,
) -> _AttitudeSample | None:
    """Return how a ring's plate lies by a frame; None: one of the two poses lacks a part."""
    if frame.pose is None or frame.cov is None or frame.by_positions is None:
        return None
    if ring.pose is None or ring.pose_cov is None:
        return None
    world_from_camera = frame.pose.world_from_camera
    slopes = np.swapaxes(frame.by_positions[3:], 0, 1)
    by_positions = dict(zip(frame.used, slopes, strict=True))
    cov = frame.cov[3:, 3:] - _turn_cov(by_positions, position_covs)
    cov = cov + world_from_camera @ ring.pose_cov[3:, 3:] @ world_from_camera.T
    readout = Readout.of(camera, ring.centre_px[None], rotation)
    if readout is not None:
        turn, turn_sd = _turn_until_row(frame.pose, readout)
        world_from_camera = rotation_about(turn) @ world_from_camera
        cov = cov + turn_sd**2 * np.eye(3)
    return _AttitudeSample(world_from_camera @ ring.pose.rotation, cov, by_positions)


def _turn_cov(
    slopes: Mapping[str, FloatArray], position_covs: Mapping[str, FloatArray | None]
) -> FloatArray:
    """Return the covariance (3, 3) of a turn by its slopes and what positions are off by."""
    total = np.zeros((3, 3))
    for name, slope in slopes.items():
        position_cov = position_covs[name]
        if position_cov is not None:
            total += slope @ position_cov @ slope.T
    return total


def _mean_attitude(
    samples: Sequence[_AttitudeSample], position_covs: Mapping[str, FloatArray | None]
) -> PlateAttitude:
    """Return the mean of samples that scatter by little, without those far off.

    If they scatter more than they should, the mean is so much less certain. Errors of the targets'
    positions are those of all samples.
    """
    attitudes = np.array([sample.enu_from_plate for sample in samples])
    middle = Rotation.from_matrix(attitudes).mean().as_matrix()
    for _ in range(3):
        off = Rotation.from_matrix(attitudes @ middle.T).as_rotvec()
        size = np.linalg.norm(off, axis=1)
        kept = size <= 4.0 * max(float(np.median(size)), 1e-6)
        middle = Rotation.from_matrix(attitudes[kept]).mean().as_matrix()
    off = Rotation.from_matrix(attitudes[kept] @ middle.T).as_rotvec()
    covs = np.array([sample.cov for sample in samples])[kept] + _LEAST_TURN_RAD**2 * np.eye(3)
    slopes = {name: np.zeros((3, 3)) for name in position_covs}
    for sample, is_kept in zip(samples, kept, strict=True):
        for name, slope in sample.by_positions.items():
            slopes[name] += is_kept * slope / len(off)
    common_cov = _turn_cov(slopes, position_covs)
    chi2 = float(np.sum(off * np.linalg.solve(covs, off[..., None])[..., 0]))
    factor = max(1.0, chi2 / (3.0 * max(1, len(off) - 1)))
    return PlateAttitude(middle, factor * covs.sum(axis=0) / len(off) ** 2 + common_cov)


def _is_told_apart(sighting: Sighting) -> bool:
    is_clear = sighting.ambiguity is None or sighting.ambiguity >= MIN_MARGIN
    return sighting.has_heading and is_clear


def _by_ring(
    failed: FramePose,
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    plates: Mapping[str, PlateAttitude],
    sd_scale: float,
    camera: Camera,
    rotation: SceneRotation | None,
) -> FramePose:
    """Return the pose by the best of a frame's rings; the frame as it was, if there is none.

    Most other targets must be where it puts them: the ring may have another one's name.
    """
    options = []
    for each in sightings:
        if each.target not in plates or not _is_told_apart(each):
            continue
        made = _pose_by_ring(each, positions[each.target], plates[each.target], sd_scale)
        if made is None:
            continue
        readout = Readout.of(camera, each.centre_px[None], rotation)
        pose, cov = made if readout is None else _at_middle_row(*made, readout, each.distance_m)
        agreeing = [
            _agrees(other, positions[other.target], pose, cov)
            for other in sightings
            if other is not each
        ]
        known = [agrees for agrees in agreeing if agrees is not None]
        if not known or 2 * sum(known) > len(known):
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
    """Return pose and covariance at the moment of the frame, from those at the row of one point."""
    turn, turn_sd = _turn_until_row(pose, readout)
    by_motion = np.repeat([distance_m * turn_sd, turn_sd], 3) ** 2
    return pose.moved(np.array([0.0, 0.0, 0.0, *-turn])), cov + np.diag(by_motion)


def _turn_until_row(pose: CameraPose, readout: Readout) -> tuple[FloatArray, float]:
    """Return how a camera turns (3,) from the middle row to that of one point, and how surely.

    World axes [rad]. Where the scene turns one way, the camera turns the other way.
    """
    delay_s = float(readout.delay_s[0])
    turn = -delay_s * pose.world_from_camera @ np.array(readout.rotation.velocity_rad_s)
    return turn, readout.rotation.sd_rad_s * abs(delay_s)


def _agrees(
    sighting: Sighting, place: TargetPosition, pose: CameraPose, cov: FloatArray
) -> bool | None:
    """Tell whether a measured target is at its place by a frame's pose; None: it cannot be told."""
    if sighting.pose is None or sighting.pose_cov is None:
        return None
    rotation, sight = pose.world_from_camera, pose.world_from_camera @ sighting.pose.translation_m
    off_m = pose.centre_m + sight - place.position_m
    by_pose = np.hstack((np.eye(3), -cross_matrix(sight)))
    own = sighting.pose_cov
    if sighting.common_pose_cov is not None:
        own = own + sighting.common_pose_cov
    total = by_pose @ cov @ by_pose.T + rotation @ own[:3, :3] @ rotation.T
    if place.cov_m2 is not None:
        total = total + place.cov_m2
    return bool(off_m @ np.linalg.solve(total, off_m) < _AGREEING_CHI2)


def _pose_by_ring(
    ring: Sighting, place: TargetPosition, plate: PlateAttitude, sd_scale: float
) -> tuple[CameraPose, FloatArray] | None:
    """Return the camera's pose and covariance by one ring, to first order; None: without its own.

    With R = W Mᵀ, W that of the plate, M the measured rotation and t the measured centre, and
    C = X − R t: errors α of the plate, δ and τ of the measured pose and ρ of the place give the
    rotation α − R δ and the position ρ − α × R t − R (τ + t × δ).
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
    # what the ring's own common share lacks
    cov[:3, :3] += max(0.0, sd_scale**2 - _common_share(ring) ** 2) * np.outer(sight, sight)
    if place.cov_m2 is not None:
        cov[:3, :3] += place.cov_m2
    return CameraPose(place.position_m - sight, rotation), np.asarray(cov)
