"""Comparison of measured distances with reference poses, and of detections with visibility."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations, visible_pixels
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Attempt
from kgcp.georef.target_positions import NoPosition, TargetPosition, TargetPositions
from kgcp.settings import Method
from kgcp.targets.plain import AnyTarget

# The reference of a frame is vague if its standard deviation exceeds both: this factor times the
# median, and this length.
_VAGUE_FACTOR, _VAGUE_M = 10.0, 0.1
# The motion of a rolling shutter's camera is known if its standard deviation is below this share
# of the a-priori one.
_KNOWN_MOTION = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _CameraPlace:
    """Pose of a camera by the reference when the target's row is exposed, in the ENU frame."""

    centre_m: FloatArray  # (3,): projection centre [m]
    enu_from_camera: FloatArray  # (3, 3): camera axes, as columns
    # (3, 3): covariance of the centre [m²]; None: the poses have no standard deviations
    cov_m2: FloatArray | None


@dataclass(frozen=True, slots=True)
class ReferenceSds:
    """Standard deviations of a reference distance, by origin."""

    # of errors that are independent from frame to frame [m]: the camera's reference position, its
    # motion until a rolling shutter reads the target, and the trajectory's interpolation
    independent_m: float
    # of the trajectory, attitude included [m]: errors that are correlated over some time
    trajectory_m: float
    # of lever arm and synchronisation, or of a static target's position [m]: the same in all frames
    common_m: float

    @property
    def total_m(self) -> float:
        """Standard deviation by all three [m]."""
        return math.hypot(self.independent_m, self.trajectory_m, self.common_m)

    @classmethod
    def along(
        cls, direction: FloatArray, position: TargetPosition, camera: _CameraPlace
    ) -> Self | None:
        """Return them along a line of sight, a unit vector (3,) in the ENU frame.

        None if trajectory, static target or poses have no standard deviations.
        """
        if position.cov_m2 is None or camera.cov_m2 is None:
            return None
        independent = float(direction @ camera.cov_m2 @ direction)
        total = float(direction @ position.cov_m2 @ direction)
        interpolation = 0.0
        if position.interpolation_m2 is not None:
            interpolation = min(total, float(direction @ position.interpolation_m2 @ direction))
        common = total  # of a static target
        if position.common_m is not None:
            common = min(total - interpolation, float(np.sum((direction @ position.common_m) ** 2)))
        trajectory = max(0.0, total - interpolation - common)
        return cls(math.sqrt(independent + interpolation), math.sqrt(trajectory), math.sqrt(common))


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Comparison of one attempt with the reference."""

    attempt: Attempt
    camera_m: FloatArray  # (3,): reference projection centre in the ENU frame [m]
    target_m: FloatArray  # (3,): the target's position at that time in the ENU frame [m]
    # of the distance between the two; None: trajectory or poses have no standard deviations
    sds: ReferenceSds | None
    # (2,): centre in the raw image by the reference pose [px]; NaN behind the camera
    expected_px: FloatArray
    expected_radius_px: float  # outer radius of the main ring by the reference pose [px]
    # standard deviation of the measured distance by the camera's motion while a rolling shutter
    # reads the frame, if that is unknown [m]; 0: it is known, or nothing was measured
    sd_motion_m: float = 0.0

    @property
    def reference_distance_m(self) -> float:
        """Between reference projection centre and target [m]."""
        return math.dist(self.camera_m, self.target_m)

    @property
    def residual_m(self) -> float | None:
        """Measured minus reference distance [m]; None if nothing was measured."""
        sighting = self.attempt.sighting
        return None if sighting is None else sighting.distance_m - self.reference_distance_m

    @property
    def residual_percent(self) -> float | None:
        """The residual in percent of the reference distance."""
        residual = self.residual_m
        return None if residual is None else 100.0 * residual / self.reference_distance_m

    @property
    def is_misplaced(self) -> bool:
        """Whether the measured centre is more than one ring radius from the expected one."""
        sighting = self.attempt.sighting
        if sighting is None:
            return False
        return not math.dist(sighting.centre_px, self.expected_px) <= self.expected_radius_px

    def is_whole_in(self, camera: Camera) -> bool:
        """Whether the whole ring is in the frame by the reference pose."""
        margin = self.expected_radius_px
        limit = np.array([camera.width, camera.height]) - 1.0 - margin
        return bool(np.all((self.expected_px >= margin) & (self.expected_px <= limit)))


@dataclass(frozen=True, slots=True)
class BiasStudy:
    """All comparisons of a flight, and the frames that could not be compared."""

    method: Method
    measured: tuple[Comparison, ...]  # those with a residual, in the order of the frames
    # those in which the whole target should be visible, measured or not
    expected_visible: tuple[Comparison, ...]
    # whether most measured centres are where the reference attitudes put them. If not, no centre
    # counts as misplaced, and the target is expected in every frame with a pose.
    attitudes_agree: bool
    frames_without_pose: tuple[str, ...]  # frames without a reference pose
    # frames with a reference distance far less certain than in most, for example without GNSS
    frames_with_vague_reference: tuple[str, ...]
    # frames with several plates of one code, which do not tell which of them is the target
    frames_with_several_plates: tuple[str, ...]
    absences: tuple[NoPosition, ...]  # why the target's position is unknown in some frames
    # frames with targets that the reference poses were computed from
    frames_with_orienting_targets: tuple[str, ...] = ()

    def trusts(self, pair: Comparison) -> bool:
        """Whether a comparison has a measurement that is not misplaced."""
        return pair.attempt.sighting is not None and not (
            self.attitudes_agree and pair.is_misplaced
        )

    @property
    def trusted(self) -> tuple[Comparison, ...]:
        """Measurements that the statistics use."""
        return tuple(pair for pair in self.measured if self.trusts(pair))


def study_bias(
    attempts: Sequence[Attempt],
    poses: ReferencePoses,
    target_positions: TargetPositions,
    camera: Camera,
    targets: Sequence[AnyTarget],
    method: Method,
    motions: CameraMotions | None = None,
    orienting: Collection[str] = (),
) -> BiasStudy:
    """Compare every attempt with the reference.

    Parameters
    ----------
    attempts : sequence of Attempt
        Targets that were never measured are left out, and so are those of which a frame shows
        several plates with the same code.
    motions : CameraMotions, optional
        Motion of the camera while a rolling shutter reads the frames, in the order of the poses.
        The poses are those of the middle row. None: the camera does not move, or all rows are
        exposed at once.
    orienting : collection of str
        Names of targets that the reference poses were computed from. They are left out, since their
        errors have gone into the poses.

    Raises
    ------
    KgcpError
        If nothing was measured, if no measured frame has a pose, or as
        `TargetPositions.positions`.
    """
    used = {each.frame for each in attempts if each.target in orienting}
    attempts = [each for each in attempts if each.target not in orienting]
    if used and not attempts:
        raise KgcpError(
            "the reference poses were computed from all measured targets, by 'kgcp orient', so that"
            " their distances say nothing of a bias; give [reference] poses of an adjustment"
        )
    several = {(each.frame, each.target) for each in attempts if _is_second_plate(each)}
    considered = _with_measured_target(
        [attempt for attempt in attempts if (attempt.frame, attempt.target) not in several],
        len(several),
    )
    has_pose = set(poses.frames)
    posed = [attempt for attempt in considered if attempt.frame in has_pose]
    if not any(attempt.sighting for attempt in posed):
        raise KgcpError(_no_pose(considered, poses))
    times = [
        attempt.sighting.row_time_s(camera) if attempt.sighting else attempt.time_s
        for attempt in posed
    ]
    positions = target_positions.positions([attempt.target for attempt in posed], times)
    placed = [
        (attempt, position)
        for attempt, position in zip(posed, positions, strict=True)
        if isinstance(position, TargetPosition)
    ]
    orientations = ExteriorOrientations.of(poses, target_positions.local_frame)
    places = _camera_places(
        [attempt for attempt, _ in placed], poses, orientations, motions, camera
    )
    row_of = {frame: row for row, frame in enumerate(poses.frames)}
    pairs = [
        replace(pair, sd_motion_m=_sd_by_motion(pair, camera, motions, row_of[pair.attempt.frame]))
        for pair in _compare_all(placed, places, camera, targets)
    ]
    compared, vague = _without_vague(pairs)
    measured = tuple(pair for pair in compared if pair.attempt.sighting is not None)
    agree = 2 * sum(pair.is_misplaced for pair in measured) < len(measured)
    return BiasStudy(
        method=method,
        measured=measured,
        expected_visible=tuple(pair for pair in compared if not agree or pair.is_whole_in(camera)),
        attitudes_agree=agree,
        frames_without_pose=tuple(sorted({each.frame for each in considered} - has_pose)),
        frames_with_vague_reference=vague,
        frames_with_several_plates=tuple(sorted({frame for frame, _ in several})),
        absences=tuple(position for position in positions if isinstance(position, NoPosition)),
        frames_with_orienting_targets=tuple(sorted(used)),
    )


def _camera_places(
    attempts: Sequence[Attempt],
    poses: ReferencePoses,
    orientations: ExteriorOrientations,
    motions: CameraMotions | None,
    camera: Camera,
) -> list[_CameraPlace]:
    """Return the camera's pose when the target's row of each attempt was exposed."""
    row_of = {frame: row for row, frame in enumerate(poses.frames)}
    rows = [row_of[attempt.frame] for attempt in attempts]
    delays_s = [
        0.0 if each.sighting is None else each.sighting.delay_s(camera) for each in attempts
    ]
    if motions is not None:
        orientations = motions.after(orientations, rows, np.array(delays_s))
        rows = [*range(len(attempts))]
    covs = orientations.cov_m2
    return [
        _CameraPlace(
            orientations.centre_m[row],
            orientations.enu_from_camera[row],
            None if covs is None else covs[row],
        )
        for row in rows
    ]


def _compare_all(
    placed: Sequence[tuple[Attempt, TargetPosition]],
    places: Sequence[_CameraPlace],
    camera: Camera,
    targets: Sequence[AnyTarget],
) -> list[Comparison]:
    """Compare attempts with the camera's poses in their frames."""
    diameters = {target.name: target.outer_diameter_m for target in targets}
    in_camera = [
        (position.position_m - place.centre_m) @ place.enu_from_camera
        for (_, position), place in zip(placed, places, strict=True)
    ]
    pixels = visible_pixels(camera, np.reshape(in_camera, (-1, 3)))
    return [
        _compare(
            attempt,
            position,
            place,
            pixel,
            0.5 * diameters[attempt.target] * camera.mean_focal_px,
        )
        for (attempt, position), place, pixel in zip(placed, places, pixels, strict=True)
    ]


def _sd_by_motion(
    pair: Comparison, camera: Camera, motions: CameraMotions | None, row: int
) -> float:
    """Return the standard deviation of a measured distance by an unknown motion [m]; 0: known.

    The stated one includes it. The motion from row to row stretches the ring by this share of its
    size at most, and the distance with it.
    """
    sighting = pair.attempt.sighting
    if motions is None or sighting is None or sighting.sd_distance_m is None:
        return 0.0
    shift_rad_s = float(motions.sd_velocity_m_s[row]) / sighting.distance_m
    sd_rad_s = math.hypot(float(motions.sd_turn_rad_s[row]), shift_rad_s)
    if sd_rad_s < _KNOWN_MOTION * math.radians(camera.motion_sd_deg_s):
        return 0.0
    per_row_s = abs(camera.readout_s) / (camera.height - 1)
    share = camera.mean_focal_px * math.radians(camera.motion_sd_deg_s) * per_row_s
    return min(sighting.sd_distance_m, share * sighting.distance_m)


def _without_vague(pairs: Sequence[Comparison]) -> tuple[list[Comparison], tuple[str, ...]]:
    """Return the comparisons without those of a vague reference, and the frames of the latter.

    A single error of metres, even if its standard deviation is stated correctly, would dominate an
    RMS of centimetres.
    """
    sds_m = [pair.sds.total_m for pair in pairs if pair.sds and pair.attempt.sighting]
    max_sd_m = max(_VAGUE_FACTOR * float(np.median(sds_m)), _VAGUE_M) if sds_m else math.inf
    kept, vague = [], set()
    for pair in pairs:
        if pair.sds is not None and pair.sds.total_m > max_sd_m:
            vague.add(pair.attempt.frame)
        else:
            kept.append(pair)
    return kept, tuple(sorted(vague))


def _is_second_plate(attempt: Attempt) -> bool:
    return attempt.sighting is not None and attempt.sighting.instance > 0


def _with_measured_target(attempts: Sequence[Attempt], several: int) -> list[Attempt]:
    measured = {attempt.target for attempt in attempts if attempt.sighting is not None}
    if not measured and several:
        raise KgcpError(
            f"all {several} measurements are in frames with several plates of the same code, which"
            " do not tell which of them is the target; cover the others, or leave them at home"
        )
    if not measured:
        raise KgcpError(
            f"no target was measured in {len(attempts)} attempts, so that there is nothing to"
            " compare; see the reasons that 'kgcp detect' prints"
        )
    return [attempt for attempt in attempts if attempt.target in measured]


def _no_pose(attempts: Sequence[Attempt], poses: ReferencePoses) -> str:
    measured = next(attempt.frame for attempt in attempts if attempt.sighting is not None)
    posed = f"'{poses.frames[0]}'" if poses.frames else "no frame at all"
    return (
        f"no measured frame has a reference pose: the target was measured in '{measured}', for"
        f" example, but the file of [reference] poses names {posed}; its names must be relative to"
        " the frames folder"
    )


def _compare(
    attempt: Attempt,
    position: TargetPosition,
    camera: _CameraPlace,
    expected_px: FloatArray,
    radius_px_m: float,
) -> Comparison:
    """Compare one attempt with the pose of the camera."""
    sight = position.position_m - camera.centre_m
    distance = float(np.linalg.norm(sight))
    return Comparison(
        attempt=attempt,
        camera_m=camera.centre_m,
        target_m=position.position_m,
        sds=ReferenceSds.along(sight / distance, position, camera),
        expected_px=expected_px,
        expected_radius_px=radius_px_m / distance,
    )


@dataclass(frozen=True, slots=True)
class EdgeDistances:
    """Distances of one target by its edges, which exposure displaces."""

    by_outer_edge_m: float  # affected by the displacement of that edge [m]
    by_both_edges_m: float  # free of it, because the common displacement cancels out [m]
    outer_radius_px: float  # of the displaced outer edge [px]


def edge_distances(pair: Comparison, method: Method) -> EdgeDistances | None:
    """Return both distances of a comparison; None if it has no measurement, or no edge shift δ.

    Exposure displaces the outer edge by δ towards the dark ring, from the radius R to R − δ.
    Distances are inversely proportional to the radius. The paper's chain takes the pose from the
    outer edge, and is affected; the image model estimates the displacement of edges, and is not.
    """
    sighting, exposure = pair.attempt.sighting, pair.attempt.exposure
    if sighting is None or exposure.edge_shift_px is None or exposure.radius_px is None:
        return None
    if method is Method.PAPER:  # its radius is that of the displaced edge
        share = exposure.edge_shift_px / exposure.radius_px
        return EdgeDistances(
            sighting.distance_m, sighting.distance_m / (1.0 + share), exposure.radius_px
        )
    displaced_px = exposure.radius_px - exposure.edge_shift_px
    by_outer_edge_m = sighting.distance_m * exposure.radius_px / displaced_px
    return EdgeDistances(by_outer_edge_m, sighting.distance_m, displaced_px)
