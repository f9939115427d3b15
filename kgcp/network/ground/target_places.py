"""Static targets placed from all frames with a known orientation, and compared with flight.toml.

A frame's pose of a coded ring depends on the diameter in flight.toml. The moments of its outer
circle in the image do not, and they are nearly the same for both poses of the circle. So rings are
placed from these moments, which are computed from the pose; the diameter is estimated as a check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.calibration import CalibrationCovariance
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_derivatives
from kgcp.geometry.pose import Pose
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import static_position
from kgcp.network.ground.circles_together import MovedCircleError, place_circles
from kgcp.network.ground.moved_circle import Split
from kgcp.network.ground.space_circle import CircleViews, ExtraNoise, NoCircleError, SpaceCircle
from kgcp.network.ground.target_plane import (
    MAX_EXTRA_PX,
    PlacedCircle,
    common_covariance,
)
from kgcp.targets.plain import AnyTarget, Shape, shape_of

# Smallest standard deviation of an outline. No print is better; it also keeps the covariance of a
# frontal view regular.
_MIN_OUTLINE_SD_PX = 0.0005
# Common displacement of edges. It is zero for coded rings: their measurement estimates it.
_CODED_EDGE_SD_PX = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTarget:
    """A static target placed from many frames.

    Attributes
    ----------
    target : str
        Name in flight.toml.
    shape : Shape
    frames : tuple of str
        All n frames with the target and a known orientation.
    is_used : (n,) array
        Whether a frame agrees; the others are left out.
    residuals : (n, 5) array
        Observed minus computed centroid [px] and second moments [px²].
    chi2 : (n,) array
        Squared residuals of each frame over their covariance; five numbers each.
    position_map : (3,) array
        Centre x, y, z in the flight's CRS.
    normal : (3,) array
        Unit vector in the map's axes towards the side from which the target is seen; (0, 0, 1) for
        a level target.
    other_normal : (3,) array or None
        The mirrored normal, adjusted as well; None: that adjustment leads to the same normal.
    ambiguity : float
        Δχ² by which the mirrored normal fits worse.
    diameter_m : float
    cov, common_cov : (6, 6) array
        Covariances of x, y, z in the map's axes [m], of rotations about two axes perpendicular to
        the normal [rad], and of the radius [m]. The first axis is the map's x axis projected into
        the target's plane. `cov` is from errors that differ between frames, `common_cov` from
        errors that all frames share.
    variance_factor : float
        χ² per degree of freedom.
    own_noise_px : float or None
        Standard deviation of its images beyond the stated one [px], if it is far larger than that
        of most targets; None: it is not. If it is, the sum of both covariances is that of a single
        frame, because such errors may be the same in many frames.
    move : TargetMove or None
        A move of the target during the flight. The target is placed from the frames of one place.
        None: there are no signs of a move.
    step : TargetMove or None
        A step of the reference poses; for a single target, this or a move of the target. The target
        is placed from the frames of both places, and the sum of both covariances is that of a
        single frame. None: there are no signs of a step.
    check : PlaceCheck
        Comparison with flight.toml.
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
        """Sum of both covariances (6, 6)."""
        return np.asarray(self.cov + self.common_cov)

    @property
    def sds(self) -> FloatArray:
        """Standard deviations (6,) by `total_cov`: x, y, z [m], rotations [rad], radius [m]."""
        return np.asarray(np.sqrt(np.diag(self.total_cov)))

    @property
    def sd_diameter_m(self) -> float:
        """Standard deviation of the diameter [m]."""
        return 2.0 * float(self.sds[5])

    @property
    def tilt_deg(self) -> float:
        """Angle between the normal and the vertical [deg]."""
        return math.degrees(math.atan2(math.hypot(*self.normal[:2]), self.normal[2]))

    @property
    def sd_normal_deg(self) -> float:
        """Standard deviation of the normal about its weakest axis [deg]."""
        return math.degrees(math.sqrt(float(np.linalg.eigvalsh(self.total_cov[3:5, 3:5])[-1])))

    @property
    def worst_frame(self) -> str:
        """The frame with the largest χ²."""
        return self.frames[int(np.argmax(self.chi2))]


@dataclass(frozen=True, slots=True)
class TargetMove:
    """An apparent change of a target's place during a flight."""

    frame: str  # the first frame that shows the second place
    distance_m: float  # approximate distance between the two places

    @property
    def as_move(self) -> str:
        """The change in words, as a move of the target."""
        return (
            f"was moved by about {self.distance_m:.2g} m, or others were taken for it: from"
            f" {self.frame} on, its images show another place"
        )


@dataclass(frozen=True, slots=True, eq=False)
class PlaceCheck:
    """Comparison of a placed target with flight.toml."""

    # (3,): placed minus stated, in the map's axes [m]; None: flight.toml states no position
    residual_m: FloatArray | None
    cov_m2: FloatArray | None  # (3, 3): its covariance, including that of the stated position
    is_rough: bool  # whether the accuracy of the stated position is unknown
    stated_diameter_m: float
    diameter_residual_m: float  # placed minus stated
    sd_diameter_residual_m: float

    @property
    def diameter_permille(self) -> float:
        """Residual of the diameter [‰]."""
        return 1e3 * self.diameter_residual_m / self.stated_diameter_m

    @property
    def position_chi2(self) -> float | None:
        """χ² of the place, of three coordinates."""
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
        For targets that were not placed: name → reason.
    noise : ExtraNoise
        Noise beyond the stated one, from the residuals of all targets without their own.
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
        In the frames' order; those in frames with several plates of a code are left out.
    targets : sequence of Target or PlainTarget
        Static targets.
    poses : ReferencePoses
        Their standard deviations are used unless `has_exact_poses`.
    min_frames : int
        Least number of frames.
    has_exact_poses : bool
        Whether the standard deviations of the reference poses are ignored.
    motions : CameraMotions, optional
        For a rolling shutter: motion of the camera at each reference pose.
    """
    orientations = ExteriorOrientations.of(poses, local_frame)
    if has_exact_poses:
        orientations = replace(orientations, cov=None)
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    skipped: dict[str, str] = {}
    usable, all_views, all_frames = [], [], []
    for target in targets:
        named = [each for each in sightings if each.target == target.name]
        of_target = unmistakable(named)
        posed = [each for each in of_target if each.frame in rows and _has_pose(each)]
        if len(posed) < min_frames:
            several = sum(not each.instance for each in named) - len(of_target)
            skipped[target.name] = _too_few(of_target, posed, rows, min_frames, several)
            continue
        at = [rows[each.frame] for each in posed]
        moments, cov = _images(camera, posed, 0.5 * target.outer_diameter_m)
        views = CircleViews(
            orientations.centre_m[at],
            orientations.enu_from_camera[at],
            moments,
            cov,
            None if orientations.cov is None else orientations.cov[at],
            frames=np.array(at),
        )
        usable.append(target)
        all_frames.append(tuple(each.frame for each in posed))
        if motions is not None:
            views = _at_their_rows(camera, views, orientations, motions, at)
        all_views.append(views)
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
        own_px = outcome.noise.centre_px if outcome.has_own_noise else None
        if own_px is not None and own_px >= MAX_EXTRA_PX:
            skipped[target.name] = (
                f"its images contradict each other by {MAX_EXTRA_PX:.0f} px or more, those of"
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
            # such errors may be the same in many frames: averaging does not reduce them
            common = common + (np.count_nonzero(outcome.fit.is_used) - 1.0) * outcome.fit.cov
        placed.append(_on_the_map(target, frames, outcome, own_px, common, local_frame))
    return Placement(tuple(placed), skipped, noise)


def _at_their_rows(
    camera: Camera,
    views: CircleViews,
    orientations: ExteriorOrientations,
    motions: CameraMotions,
    at: Sequence[int],
) -> CircleViews:
    """Return views with the poses of a rolling shutter's camera at the circles' rows.

    Where poses do not show the motion, it counts as the same in all frames, since a flight mostly
    has one speed.
    """
    delay_s = camera.delay_s(views.moments[:, :2])
    moved = motions.after(orientations, at, delay_s)
    is_common = ~motions.is_observed[at]
    effects = np.zeros((len(at), 6, 6))
    for part, sd in (
        (slice(0, 3), motions.sd_velocity_m_s[at]),
        (slice(3, 6), motions.sd_turn_rad_s[at]),
    ):
        effects[:, part, part] = (is_common * delay_s * sd)[:, None, None] * views.world_from_camera
    return replace(
        views,
        camera_m=moved.centre_m,
        world_from_camera=moved.enu_from_camera,
        exterior_cov=moved.cov,
        common_effects=effects if is_common.any() else None,
    )


def _moved(move: Split, frames: Sequence[str]) -> TargetMove:
    return TargetMove(frames[move.first], float(np.linalg.norm(move.off_m)))


def _has_pose(sighting: Sighting) -> bool:
    return sighting.pose is not None and sighting.pose_cov is not None


def _too_few(
    of_target: Sequence[Sighting],
    posed: Sequence[Sighting],
    rows: Mapping[str, int],
    min_frames: int,
    several: int,
) -> str:
    besides = f", besides {several} that show several plates with its code" * (several > 0)
    if not of_target:
        return f"measured in no frame{besides}"
    oriented = sum(each.frame in rows for each in of_target)
    if oriented > len(posed):
        return f"{oriented - len(posed)} of its measurements have no covariance"
    return (
        f"measured in {len(of_target)} frames{besides}, {len(posed)} of them with a reference pose;"
        f" {min_frames} are needed"
    )


def _images(
    camera: Camera, sightings: Sequence[Sighting], radius_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return moments (n, 5) and covariances (n, 5, 5) of a target's outer circle.

    Those of a plain target are measured. They are not computed from its poses, because these depend
    on the prior of the normal, which would count n times in n frames.
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
    """Return moments (n, 5) of circles and covariances (n, 5, 5) from n measured poses.

    Of the six parameters of a pose, the rotation about the normal does not affect the circle. The
    other five and the five moments determine each other.

    Parameters
    ----------
    poses, pose_covs
        Poses of the targets in the camera frame, measured with this radius.
    radius_m : float
        Radius of the circle.
    """
    slopes = circle_derivatives(camera, _circles(poses, radius_m))
    by_pose = np.concatenate((slopes.by_centre, slopes.by_rotation), axis=2)
    cov = by_pose @ np.array(pose_covs) @ np.swapaxes(by_pose, 1, 2)
    return slopes.moments, _with_floor(slopes.moments, cov)


def _with_floor(moments: FloatArray, cov: FloatArray) -> FloatArray:
    """Return covariances (n, 5, 5) enlarged by the least error of an outline."""
    size = np.sqrt(np.maximum(moments[:, 2] + moments[:, 4], 0.0))
    floor = np.ones((len(moments), 5))
    floor[:, 2:] = size[:, None]
    return np.asarray(cov + _MIN_OUTLINE_SD_PX**2 * floor[:, :, None] ** 2 * np.eye(5))


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
    """Return a circle in the map's axes, compared with the statements on its target."""
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
    """Compare a circle with the stated position and diameter of its target."""
    residual, residual_cov, is_rough = None, None, True
    if target.position_m is not None:
        stated = static_position(target.position_m, target, local_frame)
        residual = enu_from_map.T @ (circle.centre_m - stated.position_m)
        residual_cov = cov[:3, :3]
        if stated.cov_m2 is not None:
            is_rough = False
            residual_cov = residual_cov + enu_from_map.T @ stated.cov_m2 @ enu_from_map
    diameter_m = target.outer_diameter_m
    return PlaceCheck(
        residual,
        residual_cov,
        is_rough,
        diameter_m,
        2.0 * circle.radius_m - diameter_m,
        math.hypot(2.0 * math.sqrt(cov[5, 5]), target.sd_outer_diameter_m),
    )
