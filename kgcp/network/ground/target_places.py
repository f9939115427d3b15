"""Static targets placed from all frames with a known orientation, and compared with flight.toml.

Of a coded ring a frame gives the pose, for which its configured diameter was used. What was
measured is the image: the moments of its outer circle. They do not depend on the diameter, and
both poses of the circle have nearly the same. So the ring is placed from its moments, and its
diameter comes out as a check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_derivatives
from kgcp.geometry.pose import Pose
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import static_position
from kgcp.network.ground.circles_together import MovedCircleError, place_circles
from kgcp.network.ground.moved_circle import Split
from kgcp.network.ground.space_circle import CircleViews, ExtraNoise, NoCircleError, SpaceCircle
from kgcp.network.ground.target_plane import (
    MOST_EXTRA_PX,
    PlacedCircle,
    common_covariance,
)
from kgcp.targets.plain import AnyTarget, Shape, shape_of

_FLOOR_PX = 0.0005  # of the outline: no print is better, and a frontal view has no singular pose
_CODED_EDGE_SD_PX = 0.0  # displaced edges are an unknown of every measurement of a coded ring


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTarget:
    """A static target placed from many frames.

    Attributes
    ----------
    target : str
        Name in flight.toml.
    shape : Shape
        What is on it.
    frames : tuple of str
        All n frames with the target and a known orientation.
    is_used : (n,) array
        Which of them agree; the others are left out.
    residuals : (n, 5) array
        Observed minus computed centroid [px] and second moments [px²].
    chi2 : (n,) array
        Squared residuals of each frame over their covariance; five numbers each.
    position_map : (3,) array
        Centre x, y, z in the flight's CRS.
    normal : (3,) array
        Unit vector along the map's axes towards the side from which the target is seen; (0, 0, 1)
        if it lies level.
    other_normal : (3,) array or None
        The mirrored normal that fits nearly as well; None: it leads to the same one.
    ambiguity : float
        Δχ² by which the mirrored normal fits worse.
    diameter_m : float
    cov, common_cov : (6, 6) array
        x, y, z along the map's axes [m]; turns about two axes square to the normal [rad], of which
        the first is the map's x made square to it; radius [m]. `cov` has what differs between
        frames, `common_cov` what all frames share.
    variance_factor : float
        Squares of the residuals over what was expected.
    own_noise_px : float or None
        How far its images deviate beyond what is stated [px], if by far more than those of most
        targets; None: they do not. If they do, both covariances together are those of a single
        frame: more frames do not reduce what may be alike in many.
    move : TargetMove or None
        That it was moved during the flight, and placed by the frames of one place; None: nothing is
        seen of that.
    step : TargetMove or None
        That the reference poses step, or, of a single target, that this or a move of the target
        shows; it is placed by the frames of both places, and both covariances together are those
        of a single frame. None: nothing is seen of that.
    check : PlaceCheck
        Against flight.toml.
    """

    target: str
    shape: Shape
    frames: tuple[str, ...]
    is_used: BoolArray
    residuals: FloatArray
    chi2: FloatArray
    position_map: FloatArray
    normal: FloatArray
    other_normal: FloatArray | None
    ambiguity: float
    diameter_m: float
    cov: FloatArray
    common_cov: FloatArray
    variance_factor: float
    own_noise_px: float | None
    move: TargetMove | None
    step: TargetMove | None
    check: PlaceCheck

    @property
    def total_cov(self) -> FloatArray:
        """Both covariances together (6, 6)."""
        return np.asarray(self.cov + self.common_cov)

    @property
    def sds(self) -> FloatArray:
        """Standard deviations (6,) by both covariances: x, y, z [m], turns [rad], radius [m]."""
        return np.asarray(np.sqrt(np.diag(self.total_cov)))

    @property
    def sd_diameter_m(self) -> float:
        """Standard deviation of the diameter [m]."""
        return 2.0 * float(self.sds[5])

    @property
    def tilt_deg(self) -> float:
        """Angle between normal and vertical [deg]."""
        return math.degrees(math.atan2(math.hypot(*self.normal[:2]), self.normal[2]))

    @property
    def sd_normal_deg(self) -> float:
        """Standard deviation of the normal about the worse one of its axes [deg]."""
        return math.degrees(math.sqrt(float(np.linalg.eigvalsh(self.total_cov[3:5, 3:5])[-1])))

    @property
    def worst_frame(self) -> str:
        """The frame that fits least."""
        return self.frames[int(np.argmax(self.chi2))]


@dataclass(frozen=True, slots=True)
class TargetMove:
    """A target that has two places in a flight."""

    frame: str  # the first that shows the second place
    distance_m: float  # between them, nearly

    @property
    def as_move(self) -> str:
        """The words for a target that did not stay where it was."""
        return (
            f"was moved by about {self.distance_m:.2g} m, or others were taken for it: from"
            f" {self.frame} on, its images show another place"
        )


@dataclass(frozen=True, slots=True, eq=False)
class PlaceCheck:
    """A placed target against what flight.toml says of it."""

    # (3,): placed minus stated, along the map's axes [m]; None: flight.toml states no position
    residual_m: FloatArray | None
    cov_m2: FloatArray | None  # (3, 3): its covariance, that of the stated position included
    stated_diameter_m: float
    diameter_residual_m: float  # placed minus stated
    sd_diameter_residual_m: float

    @property
    def diameter_permille(self) -> float:
        """Residual of the diameter [‰]."""
        return 1e3 * self.diameter_residual_m / self.stated_diameter_m

    @property
    def position_chi2(self) -> float | None:
        """Squared residual of the place over its covariance; three numbers."""
        if self.residual_m is None or self.cov_m2 is None:
            return None
        return float(self.residual_m @ np.linalg.solve(self.cov_m2, self.residual_m))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """All static targets of a flight.

    Attributes
    ----------
    targets : tuple of PlacedTarget
    skipped : mapping of str to str
        Why a target was not placed, by its name.
    noise : ExtraNoise
        Deviations beyond the stated ones that the residuals of all targets show, but of those that
        have their own.
    """

    targets: tuple[PlacedTarget, ...]
    skipped: Mapping[str, str]
    noise: ExtraNoise


def place_targets(
    sightings: Sequence[Sighting],
    targets: Sequence[AnyTarget],
    poses: ReferencePoses,
    local_frame: LocalFrame,
    camera: Camera,
    calibration: CalibrationCovariance | None,
    *,
    min_frames: int,
    has_exact_poses: bool,
    motions: CameraMotions | None = None,
) -> Placement:
    """Place targets from all their sightings in frames with a reference pose.

    Parameters
    ----------
    sightings : sequence of Sighting
        In the frames' order; second plates with the same code are passed over.
    targets : sequence of Target or PlainTarget
        That stand still.
    poses : ReferencePoses
        With standard deviations, unless they are to count as exact.
    min_frames : int
        Least number of frames.
    has_exact_poses : bool
        Whether the deviations of the reference poses are disregarded.
    motions : CameraMotions, optional
        At the reference poses, of a rolling shutter's camera.
    """
    orientations = ExteriorOrientations.of(poses, local_frame)
    exterior_cov = None if has_exact_poses else _exterior_cov(poses, orientations)
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    skipped: dict[str, str] = {}
    usable, all_views, all_frames = [], [], []
    for target in targets:
        mine = [each for each in sightings if each.target == target.name and not each.instance]
        posed = [each for each in mine if each.frame in rows and _has_pose(each)]
        if len(posed) < min_frames:
            skipped[target.name] = _too_few(mine, posed, rows, min_frames)
            continue
        at = [rows[each.frame] for each in posed]
        moments, cov = _images(camera, posed, 0.5 * target.outer_diameter_m)
        views = CircleViews(
            orientations.centre_m[at],
            orientations.enu_from_camera[at],
            moments,
            cov,
            None if exterior_cov is None else exterior_cov[at],
        )
        usable.append(target)
        all_frames.append(tuple(each.frame for each in posed))
        all_views.append(views if motions is None else _at_their_rows(camera, views, motions, at))
    outcomes, noise = place_circles(camera, all_views)
    placed = []
    for target, frames, views, outcome in zip(usable, all_frames, all_views, outcomes, strict=True):
        if isinstance(outcome, MovedCircleError):
            move = _moved(outcome.move, frames)
            skipped[target.name] = (
                f"{move.as_move}, and no more than half of its frames agree on one"
            )
            continue
        if isinstance(outcome, NoCircleError):
            skipped[target.name] = str(outcome)
            continue
        own_px = outcome.noise.centre_px if outcome.is_apart else None
        if own_px is not None and own_px >= MOST_EXTRA_PX:
            skipped[target.name] = (
                f"its images contradict each other by {MOST_EXTRA_PX:.0f} px or more, those of"
                " other targets do not"
            )
            continue
        common = common_covariance(
            camera,
            views,
            outcome.fit,
            outcome.noise,
            None if calibration is None else calibration.cov,
            _CODED_EDGE_SD_PX,
        )
        if own_px is not None or outcome.step is not None:
            # contradictions and steps may be alike in many frames: more frames do not reduce them
            common = common + (np.count_nonzero(outcome.fit.is_used) - 1.0) * outcome.fit.cov
        placed.append(_on_the_map(target, frames, outcome, own_px, common, local_frame))
    return Placement(tuple(placed), skipped, noise)


def _at_their_rows(
    camera: Camera, views: CircleViews, motions: CameraMotions, at: Sequence[int]
) -> CircleViews:
    """Return views from where a rolling shutter's camera is when the circle's row is exposed.

    A motion that no poses tell is mostly the same in all frames: flown with the same speed.
    """
    delay_s = camera.delay_s(views.moments[:, :2])
    turns = delay_s[:, None] * motions.turn_rad_s[at]
    effects = np.zeros((len(at), 6, 6))
    shift_sds_m, turn_sds = (
        delay_s * motions.sd_velocity_m_s[at],
        delay_s * motions.sd_turn_rad_s[at],
    )
    effects[:, :3, :3] = shift_sds_m[:, None, None] * views.world_from_camera
    effects[:, 3:, 3:] = turn_sds[:, None, None] * views.world_from_camera
    cov = effects @ np.swapaxes(effects, 1, 2)
    is_common = ~motions.is_seen[at]
    return replace(
        views,
        camera_m=views.camera_m + delay_s[:, None] * motions.velocity_m_s[at],
        world_from_camera=Rotation.from_rotvec(turns).as_matrix() @ views.world_from_camera,
        exterior_cov=cov if views.exterior_cov is None else views.exterior_cov + cov,
        common_effects=effects * is_common[:, None, None] if is_common.any() else None,
    )


def _moved(move: Split, frames: Sequence[str]) -> TargetMove:
    return TargetMove(frames[move.first], float(np.linalg.norm(move.off_m)))


def _has_pose(sighting: Sighting) -> bool:
    return sighting.pose is not None and sighting.pose_cov is not None


def _too_few(
    mine: Sequence[Sighting],
    posed: Sequence[Sighting],
    rows: Mapping[str, int],
    min_frames: int,
) -> str:
    if not mine:
        return "measured in no frame"
    oriented = sum(each.frame in rows for each in mine)
    if oriented > len(posed):
        return f"{oriented - len(posed)} of its measurements have no covariance"
    return (
        f"measured in {len(mine)} frames, {len(posed)} of them with a reference pose;"
        f" {min_frames} are needed"
    )


def _exterior_cov(poses: ReferencePoses, orientations: ExteriorOrientations) -> FloatArray | None:
    """Return the covariances (n, 6, 6) of positions [m] and turns [rad] in the ENU frame."""
    if orientations.cov_m2 is None and poses.sd_angle_deg is None:
        return None
    cov = np.zeros((len(poses.frames), 6, 6))
    if orientations.cov_m2 is not None:
        cov[:, :3, :3] = orientations.cov_m2
    if poses.sd_angle_deg is not None:
        cov[:, 3:, 3:] = np.radians(poses.sd_angle_deg)[:, None, None] ** 2 * np.eye(3)
    return cov


def _images(
    camera: Camera, sightings: Sequence[Sighting], radius_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return moments (n, 5) and covariances (n, 5, 5) of a target's outer circle.

    Those of a plain target were measured: its pose has what was assumed of its normal in it, which
    n frames together would make √n times surer.
    """
    plain = [each.image for each in sightings if each.image is not None]
    if len(plain) == len(sightings):
        moments = np.array([each.moments for each in plain])
        return moments, _with_floor(moments, np.array([each.cov for each in plain]))
    poses = [each.pose for each in sightings if each.pose is not None]
    covs = [each.pose_cov for each in sightings if each.pose_cov is not None]
    return ring_images(camera, poses, covs, radius_m)


def ring_images(
    camera: Camera, poses: Sequence[Pose], pose_covs: Sequence[FloatArray], radius_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return moments (n, 5) of circles, and their covariances (n, 5, 5), by n measured poses.

    A pose has six numbers, of which the turn about the normal does not move the circle: the five
    others and the five moments follow from each other.

    Parameters
    ----------
    poses, pose_covs
        Of the targets in the camera frame, as measured with this radius.
    radius_m : float
        Of the circle that was assumed.
    """
    slopes = circle_derivatives(camera, _circles(poses, radius_m))
    by_pose = np.concatenate((slopes.by_centre, slopes.by_rotation), axis=2)
    cov = by_pose @ np.array(pose_covs) @ np.swapaxes(by_pose, 1, 2)
    return slopes.moments, _with_floor(slopes.moments, cov)


def _with_floor(moments: FloatArray, cov: FloatArray) -> FloatArray:
    """Return covariances (n, 5, 5) of which none is smaller than prints allow."""
    size = np.sqrt(np.maximum(moments[:, 2] + moments[:, 4], 0.0))
    floor = np.ones((len(moments), 5))
    floor[:, 2:] = size[:, None]
    return np.asarray(cov + _FLOOR_PX**2 * floor[:, :, None] ** 2 * np.eye(5))


def _circles(poses: Sequence[Pose], radius_m: float) -> Circles3D:
    return Circles3D(
        np.array([pose.translation_m for pose in poses]),
        np.array([pose.rotation[:, :2] for pose in poses]),
        np.full(len(poses), radius_m),
    )


def _on_the_map(
    target: AnyTarget,
    frames: tuple[str, ...],
    placed: PlacedCircle,
    own_noise_px: float | None,
    common_cov: FloatArray,
    local_frame: LocalFrame,
) -> PlacedTarget:
    """Return a circle in the axes of the map, compared with what is stated of its target."""
    fit = placed.fit
    circle = fit.circle
    enu_from_map = local_frame.grid_rotation(circle.centre_m)
    on_map = _turned(circle, enu_from_map)
    to_map = np.zeros((6, 6))
    to_map[:3, :3] = enu_from_map.T
    to_map[3:5, 3:5] = on_map.axes.T @ enu_from_map.T @ circle.axes
    to_map[5, 5] = 1.0
    cov, common_cov = to_map @ fit.cov @ to_map.T, to_map @ common_cov @ to_map.T
    other = placed.other
    return PlacedTarget(
        target=target.name,
        shape=shape_of(target),
        frames=frames,
        is_used=fit.is_used,
        residuals=fit.residuals,
        chi2=fit.chi2,
        position_map=local_frame.map_from_enu(circle.centre_m[None])[0],
        normal=on_map.normal,
        other_normal=None if other is None else enu_from_map.T @ other.circle.normal,
        ambiguity=placed.ambiguity,
        diameter_m=2.0 * circle.radius_m,
        cov=cov,
        common_cov=common_cov,
        variance_factor=fit.variance_factor,
        own_noise_px=own_noise_px,
        move=None if placed.move is None else _moved(placed.move, frames),
        step=None if placed.step is None else _moved(placed.step, frames),
        check=_check(target, circle, cov + common_cov, enu_from_map, local_frame),
    )


def _turned(circle: SpaceCircle, enu_from_map: FloatArray) -> SpaceCircle:
    return SpaceCircle(
        enu_from_map.T @ circle.centre_m, enu_from_map.T @ circle.normal, circle.radius_m
    )


def _check(
    target: AnyTarget,
    circle: SpaceCircle,
    cov: FloatArray,
    enu_from_map: FloatArray,
    local_frame: LocalFrame,
) -> PlaceCheck:
    """Compare a circle with the stated place and diameter of its target."""
    residual, residual_cov = None, None
    if target.position_m is not None:
        stated = static_position(target.position_m, target, local_frame)
        residual = enu_from_map.T @ (circle.centre_m - stated.position_m)
        residual_cov = cov[:3, :3]
        if stated.cov_m2 is not None:
            residual_cov = residual_cov + enu_from_map.T @ stated.cov_m2 @ enu_from_map
    diameter_m = target.outer_diameter_m
    return PlaceCheck(
        residual,
        residual_cov,
        diameter_m,
        2.0 * circle.radius_m - diameter_m,
        math.hypot(2.0 * math.sqrt(cov[5, 5]), target.sd_outer_diameter_m),
    )
