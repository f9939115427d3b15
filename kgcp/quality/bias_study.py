"""How well measured distances agree with reference poses, and how often the target is found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
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

_VAGUE_TIMES, _VAGUE_M = 10.0, 0.1
"""A reference is vague beyond so many medians of the standard deviations, and so many metres."""


@dataclass(frozen=True, slots=True, eq=False)
class _CameraPlace:
    """Where the reference puts a camera when the target is exposed, in the ENU frame."""

    centre_m: FloatArray  # (3,): projection centre [m]
    enu_from_camera: FloatArray  # (3, 3): camera axes, as columns
    # (3, 3): covariance of the centre [m²]; None: the poses have no deviations
    cov_m2: FloatArray | None


@dataclass(frozen=True, slots=True)
class ReferenceSds:
    """Standard deviations of a reference distance, by where they come from."""

    # of what is independent from frame to frame: the camera's reference position, its way until a
    # rolling shutter has read the target, and the target's way between the trajectory's epochs [m]
    independent_m: float
    place_m: float  # of the trajectory, attitude included: an error that lasts for a while [m]
    # of lever arm and synchronisation, or of a static target's position [m]: the same in all frames
    common_m: float

    @property
    def total_m(self) -> float:
        """All three together [m]."""
        return math.hypot(self.independent_m, self.place_m, self.common_m)

    @classmethod
    def along(
        cls, direction: FloatArray, position: TargetPosition, camera: _CameraPlace
    ) -> Self | None:
        """Return those along a line of sight: a unit vector (3,) in the ENU frame.

        None where trajectory, static target or poses have no standard deviations.
        """
        if position.cov_m2 is None or camera.cov_m2 is None:
            return None
        independent = float(direction @ camera.cov_m2 @ direction)
        whole = float(direction @ position.cov_m2 @ direction)
        between = 0.0
        if position.interpolation_m2 is not None:
            between = min(whole, float(direction @ position.interpolation_m2 @ direction))
        common = whole  # of a static target
        if position.common_m is not None:
            common = min(whole - between, float(np.sum((direction @ position.common_m) ** 2)))
        place = max(0.0, whole - between - common)
        return cls(math.sqrt(independent + between), math.sqrt(place), math.sqrt(common))


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """One attempt against the reference."""

    attempt: Attempt
    # (3,): reference projection centre, and the target's place at that time, in the ENU frame [m]
    camera_m: FloatArray
    place_m: FloatArray
    # of the distance between the two; None where trajectory or poses have none
    sds: ReferenceSds | None
    # (2,): where the reference pose puts the centre in the raw image [px]; NaN behind the camera
    expected_px: FloatArray
    expected_radius_px: float  # outer radius that the main ring has there [px]

    @property
    def reference_distance_m(self) -> float:
        """Between reference projection centre and target [m]."""
        return math.dist(self.camera_m, self.place_m)

    @property
    def residual_m(self) -> float | None:
        """Measured minus reference distance [m]; None where nothing was measured."""
        sighting = self.attempt.sighting
        return None if sighting is None else sighting.distance_m - self.reference_distance_m

    @property
    def residual_percent(self) -> float | None:
        """The residual in percent of the reference distance."""
        residual = self.residual_m
        return None if residual is None else 100.0 * residual / self.reference_distance_m

    @property
    def is_misplaced(self) -> bool:
        """Whether something was measured that is not where the target must be.

        The limit is one radius of the ring.
        """
        sighting = self.attempt.sighting
        if sighting is None:
            return False
        return not math.dist(sighting.centre_px, self.expected_px) <= self.expected_radius_px

    def is_whole_in(self, camera: Camera) -> bool:
        """Whether the reference puts the whole ring into the frame."""
        margin = self.expected_radius_px
        limit = np.array([camera.width, camera.height]) - 1.0 - margin
        return bool(np.all((self.expected_px >= margin) & (self.expected_px <= limit)))


@dataclass(frozen=True, slots=True)
class BiasStudy:
    """All that could be compared."""

    method: Method
    measured: tuple[Comparison, ...]  # with a residual, in the frames' order
    # frames in which the target must be wholly visible, measured or not
    expected_visible: tuple[Comparison, ...]
    # whether most measured centres lie where the reference attitudes put them. If not, nothing is
    # called misplaced, and every frame with a pose counts as one that shows it.
    attitudes_agree: bool
    frames_without_pose: tuple[str, ...]  # frames that the reference does not name
    # frames with a reference distance far less certain than most, as while GNSS is out
    frames_with_vague_reference: tuple[str, ...]
    absences: tuple[NoPosition, ...]  # of the frames in which the position of the target is unknown

    def trusts(self, pair: Comparison) -> bool:
        """Whether a comparison holds a measurement, and one of this target."""
        return pair.attempt.sighting is not None and not (
            self.attitudes_agree and pair.is_misplaced
        )

    @property
    def trusted(self) -> tuple[Comparison, ...]:
        """Measurements that statistics are made of."""
        return tuple(pair for pair in self.measured if self.trusts(pair))


def study_bias(
    attempts: Sequence[Attempt],
    poses: ReferencePoses,
    target_positions: TargetPositions,
    camera: Camera,
    targets: Sequence[AnyTarget],
    method: Method,
    motions: CameraMotions | None = None,
) -> BiasStudy:
    """Compare every attempt with the reference.

    Parameters
    ----------
    attempts : sequence of Attempt
        One per frame and target; targets never measured are left out.
    motions : CameraMotions, optional
        How the camera moves while a rolling shutter reads the frames, in the order of the poses:
        these are those of the middle row. None: it does not move, or all rows are exposed at once.

    Raises
    ------
    KgcpError
        If nothing was measured, no measured frame has a pose, or as `TargetPositions.positions`.
    """
    ours = _with_measured_target(attempts)
    has_pose = set(poses.frames)
    posed = [attempt for attempt in ours if attempt.frame in has_pose]
    if not any(attempt.sighting for attempt in posed):
        raise KgcpError(_no_pose(ours, poses))
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
    compared, vague = _without_vague(_compare_all(placed, places, camera, targets))
    measured = tuple(pair for pair in compared if pair.attempt.sighting is not None)
    agree = 2 * sum(pair.is_misplaced for pair in measured) < len(measured)
    return BiasStudy(
        method=method,
        measured=measured,
        expected_visible=tuple(pair for pair in compared if not agree or pair.is_whole_in(camera)),
        attitudes_agree=agree,
        frames_without_pose=tuple(sorted({each.frame for each in ours} - has_pose)),
        frames_with_vague_reference=vague,
        absences=tuple(position for position in positions if isinstance(position, NoPosition)),
    )


def _camera_places(
    attempts: Sequence[Attempt],
    poses: ReferencePoses,
    orientations: ExteriorOrientations,
    motions: CameraMotions | None,
    camera: Camera,
) -> list[_CameraPlace]:
    """Return the camera's place when the target of each attempt was exposed."""
    row_of = {frame: row for row, frame in enumerate(poses.frames)}
    places = []
    for attempt in attempts:
        row = row_of[attempt.frame]
        centre = orientations.centre_m[row]
        cov = None if orientations.cov_m2 is None else orientations.cov_m2[row]
        if motions is not None and attempt.sighting is not None:
            delay_s = attempt.sighting.rows_since_middle(camera) * camera.readout_s
            centre = centre + delay_s * motions.velocity_m_s[row]
            moved_sd_m = delay_s * motions.sd_velocity_m_s[row]
            cov = None if cov is None else cov + moved_sd_m**2 * np.eye(3)
        places.append(_CameraPlace(centre, orientations.enu_from_camera[row], cov))
    return places


def _compare_all(
    placed: Sequence[tuple[Attempt, TargetPosition]],
    places: Sequence[_CameraPlace],
    camera: Camera,
    targets: Sequence[AnyTarget],
) -> list[Comparison]:
    """Compare attempts with the camera's places in their frames."""
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


def _without_vague(pairs: Sequence[Comparison]) -> tuple[list[Comparison], tuple[str, ...]]:
    """Return the comparisons without those that say nothing beside the others, and their frames.

    One error of metres, however honestly stated, would be most of an RMS over centimetres.
    """
    sds_m = [pair.sds.total_m for pair in pairs if pair.sds and pair.attempt.sighting]
    most_m = max(_VAGUE_TIMES * float(np.median(sds_m)), _VAGUE_M) if sds_m else math.inf
    kept, vague = [], set()
    for pair in pairs:
        if pair.sds is not None and pair.sds.total_m > most_m:
            vague.add(pair.attempt.frame)
        else:
            kept.append(pair)
    return kept, tuple(sorted(vague))


def _with_measured_target(attempts: Sequence[Attempt]) -> list[Attempt]:
    measured = {attempt.target for attempt in attempts if attempt.sighting is not None}
    if not measured:
        raise KgcpError(
            f"no target was measured in any of {len(attempts)} attempts; there is nothing to"
            " compare, see the reasons that 'kgcp detect' gives"
        )
    return [
        attempt
        for attempt in attempts
        if attempt.target in measured
        and (attempt.sighting is None or not attempt.sighting.instance)
    ]


def _no_pose(attempts: Sequence[Attempt], poses: ReferencePoses) -> str:
    ours = next(attempt.frame for attempt in attempts if attempt.sighting is not None)
    theirs = f"'{poses.frames[0]}'" if poses.frames else "no frame at all"
    return (
        f"no measured frame has a reference pose: measured is for example '{ours}', the file of"
        f" [reference] poses names {theirs}; its names must be relative to the frames folder"
    )


def _compare(
    attempt: Attempt,
    position: TargetPosition,
    camera: _CameraPlace,
    expected_px: FloatArray,
    radius_px_m: float,
) -> Comparison:
    """Compare one attempt with the place of the camera."""
    sight = position.position_m - camera.centre_m
    distance = float(np.linalg.norm(sight))
    return Comparison(
        attempt=attempt,
        camera_m=camera.centre_m,
        place_m=position.position_m,
        sds=ReferenceSds.along(sight / distance, position, camera),
        expected_px=expected_px,
        expected_radius_px=radius_px_m / distance,
    )


@dataclass(frozen=True, slots=True)
class EdgeDistances:
    """Distances of one target by its edges, which exposure displaces."""

    by_outer_edge_m: float  # with its displacement [m]
    by_both_edges_m: float  # whose common displacement cancels out [m]
    outer_radius_px: float  # of the displaced outer edge [px]


def edge_distances(pair: Comparison, method: Method) -> EdgeDistances | None:
    """Return both distances of a comparison; None where it has no measurement, or no δ.

    Exposure displaces the outer edge by δ towards the dark ring, from the radius R to R − δ, and
    a distance is inversely proportional to the radius. The paper's chain takes the pose from the
    outer edge; the image model has displaced edges among its unknowns.
    """
    sighting, exposure = pair.attempt.sighting, pair.attempt.exposure
    if sighting is None or exposure.edge_shift_px is None or exposure.radius_px is None:
        return None
    if method is Method.PAPER:  # there the radius is that of the displaced edge
        share = exposure.edge_shift_px / exposure.radius_px
        return EdgeDistances(
            sighting.distance_m, sighting.distance_m / (1.0 + share), exposure.radius_px
        )
    displaced_px = exposure.radius_px - exposure.edge_shift_px
    by_outer_edge_m = sighting.distance_m * exposure.radius_px / displaced_px
    return EdgeDistances(by_outer_edge_m, sighting.distance_m, displaced_px)
