"""Kinematic ground control points: sightings with positions from the vehicle's trajectory."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.local_frame import CrsTransform
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import NoPosition, TargetPosition, TargetPositions

_SAME_POSITION_RTOL = 1e-9  # corresponds to some millimetres in a northing


@dataclass(frozen=True, slots=True, eq=False)
class Gcp:
    """One kinematic ground control point: a target's position, with its image in one frame.

    Attributes
    ----------
    id : str
        `K` and the number of the frame, if wanted preceded by the flight's name. A static target
        has its own name in every frame.
    frame, target : str
        As in the sighting.
    time_s : float or None
        When the target's row was exposed, by the trajectory's clock, Unix UTC [s]; None: not
        known (static targets only).
    position_map : (3,) array
        x, y, z in the flight's CRS.
    cov_m2 : (3, 3) array or None
        Covariance along the map's axes [m²]; None: trajectory or static target have no standard
        deviations.
    centre_px, centre_cov_px2, distance_m, sd_distance_m, sd_common_distance_m
        As in the sighting.
    common_m : (3, k) array or None
        Displacements of the point, along the map's axes, by one standard deviation of each of k
        errors that all points share [m]; k = 4: lever arm x, y, z and synchronisation. They are
        included in `cov_m2`. None: the target is static, and its points in all frames are one.
    score, ambiguity
        As in the sighting.
    is_checkpoint : bool
        Whether the point is a check point of the adjustment, not a control point.
    flag : Flag or None
        What does not fit a smooth flight; None: nothing, or not examined.
    """

    id: str
    frame: str
    target: str
    time_s: float | None
    position_map: FloatArray
    cov_m2: FloatArray | None
    centre_px: FloatArray
    centre_cov_px2: FloatArray | None
    distance_m: float
    sd_distance_m: float | None
    sd_common_distance_m: float | None
    common_m: FloatArray | None = None
    score: float | None = None
    ambiguity: float | None = None
    is_checkpoint: bool = False
    flag: Flag | None = None

    @property
    def cov_common_m2(self) -> FloatArray | None:
        """Share (3, 3) of `cov_m2` that is due to errors that all points share [m²]."""
        if self.common_m is None or self.cov_m2 is None:
            return self.cov_m2
        return np.asarray(self.common_m @ self.common_m.T)


class Flag(StrEnum):
    """Property of a point that does not fit a smooth flight."""

    DISTANCE = "distance_jump"
    HEIGHT = "height_jump"


class SkipReason(StrEnum):
    """Why a sighting with a position does not become a KGCP."""

    EXCLUDED = "excluded"
    SECOND_PLATE = "second_plate"
    DISTANCE_JUMP = Flag.DISTANCE.value
    HEIGHT_JUMP = Flag.HEIGHT.value
    UNCERTAIN = "uncertain"
    LOW_SCORE = "low_score"
    AMBIGUOUS = "ambiguous"
    CLOSE = "too_close"


@dataclass(frozen=True, slots=True)
class SkippedSighting:
    """A sighting that did not become a KGCP.

    Attributes
    ----------
    frame, target : str
        As in the sighting.
    reason : NoPosition or SkipReason
        Why the target's position is unknown, or why the point is left out.
    """

    frame: str
    target: str
    reason: NoPosition | SkipReason


def build_gcps(
    sightings: Sequence[Sighting], target_positions: TargetPositions, camera: Camera
) -> tuple[tuple[Gcp, ...], tuple[SkippedSighting, ...]]:
    """Give every sighting its position on the ground.

    Parameters
    ----------
    sightings : sequence of Sighting
        In the frames' order.
    camera : Camera
        Its rolling shutter determines when a target was exposed.

    Returns
    -------
    gcps : tuple of Gcp
        In the sightings' order.
    skipped : tuple of SkippedSighting
        Sightings without a position, with the reasons.

    Raises
    ------
    KgcpError
        As `TargetPositions.positions`, or as `check_ids`.
    """
    single = unmistakable(sightings)
    times = [sighting.row_time_s(camera) for sighting in single]
    positions = target_positions.positions([sighting.target for sighting in single], times)
    usable = {(sighting.frame, sighting.target) for sighting in single}
    skipped = [
        SkippedSighting(sighting.frame, sighting.target, SkipReason.SECOND_PLATE)
        for sighting in sightings
        if (sighting.frame, sighting.target) not in usable
    ]
    placed = []
    for sighting, time_s, position in zip(single, times, positions, strict=True):
        if isinstance(position, TargetPosition):
            placed.append((sighting, time_s, position))
        else:
            skipped.append(SkippedSighting(sighting.frame, sighting.target, position))
    gcps = _on_the_map(placed, target_positions)
    check_ids(gcps)
    return gcps, tuple(skipped)


def _on_the_map(
    placed: Sequence[tuple[Sighting, float | None, TargetPosition]],
    target_positions: TargetPositions,
) -> tuple[Gcp, ...]:
    if not placed:
        return ()
    local_frame = target_positions.local_frame
    positions = np.array([place.position_m for _, _, place in placed])
    on_map, axes = local_frame.map_from_enu(positions), local_frame.grid_rotation(positions)
    return tuple(
        _gcp(sighting, time_s, position, position_map, turn, target_positions)
        for (sighting, time_s, position), position_map, turn in zip(
            placed, on_map, axes, strict=True
        )
    )


def _gcp(
    sighting: Sighting,
    time_s: float | None,
    position: TargetPosition,
    position_map: FloatArray,
    axes: FloatArray,
    target_positions: TargetPositions,
) -> Gcp:
    moves = sighting.target not in target_positions.static
    offset_s = target_positions.vehicle.settings.time_offset_s if target_positions.vehicle else 0.0
    return Gcp(
        id=f"K{sighting.number:04d}" if moves else sighting.target,
        frame=sighting.frame,
        target=sighting.target,
        time_s=None if time_s is None else time_s + offset_s,
        position_map=position_map,
        cov_m2=None if position.cov_m2 is None else axes.T @ position.cov_m2 @ axes,
        common_m=None if position.common_m is None else axes.T @ position.common_m,
        centre_px=sighting.centre_px,
        centre_cov_px2=sighting.centre_cov_px2,
        distance_m=sighting.distance_m,
        sd_distance_m=sighting.sd_distance_m,
        sd_common_distance_m=sighting.sd_common_distance_m,
        score=sighting.score,
        ambiguity=sighting.ambiguity,
    )


def check_ids(gcps: Sequence[Gcp]) -> None:
    """Check that points with the same id have the same position.

    Raises
    ------
    KgcpError
        If two of them have different positions.
    """
    first: dict[str, Gcp] = {}
    for point in gcps:
        other = first.setdefault(point.id, point)
        if np.allclose(point.position_map, other.position_map, rtol=_SAME_POSITION_RTOL, atol=1e-9):
            continue
        where = f"in {other.frame} and {point.frame}"
        if point.target != other.target:
            raise KgcpError(
                f"{point.id!r} is both a static target and a point of the moving target {where};"
                " give the static target another name in flight.toml"
            )
        raise KgcpError(
            f"static target {point.id!r} has different positions {where};"
            " give one of them another name, or correct position_m"
        )


def flight_prefix(name: str) -> str:
    """Return a flight's name as used in ids and paths: letters, digits, `_`, `.` and `-`."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_.") or "flight"


def with_flight_name(gcps: Sequence[Gcp], name: str) -> tuple[Gcp, ...]:
    """Put the flight's name before the ids of moving targets' points.

    Ids of static targets stay as they are: they are the same points in all flights.
    """
    prefix = flight_prefix(name)
    return tuple(
        point if point.id == point.target else replace(point, id=f"{prefix}-{point.id}")
        for point in gcps
    )


def transform_gcps(gcps: Sequence[Gcp], transform: CrsTransform) -> tuple[Gcp, ...]:
    """Transform the points' positions and covariances to another map.

    Raises
    ------
    KgcpError
        As `CrsTransform.positions` and `CrsTransform.axes`.
    """
    if not gcps:
        return ()
    positions = np.array([point.position_map for point in gcps])
    return tuple(map(_moved, gcps, transform.positions(positions), transform.axes(positions)))


def _moved(point: Gcp, position_map: FloatArray, axes: FloatArray) -> Gcp:
    return replace(
        point,
        position_map=position_map,
        cov_m2=None if point.cov_m2 is None else axes @ point.cov_m2 @ axes.T,
        common_m=None if point.common_m is None else axes @ point.common_m,
    )
