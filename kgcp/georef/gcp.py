"""Kinematic ground control points: sightings in frames, placed by the vehicle's trajectory."""

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
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import NoPosition, TargetPosition, TargetPositions

_SAME_PLACE = 1e-9  # relative: a millimetre or two of a northing


@dataclass(frozen=True, slots=True, eq=False)
class Gcp:
    """One kinematic ground control point: a point of the ground, seen in one frame.

    Attributes
    ----------
    id : str
        `K` and the number of the frame, perhaps behind the flight's name; for a static target its
        name, in every frame.
    frame, target : str
        As in the sighting.
    time_s : float or None
        When the target's row was exposed, by the trajectory's clock, Unix UTC [s]; None: not
        known, which only a static target can afford.
    position_map : (3,) array
        x, y, z in the flight's CRS.
    cov_m2 : (3, 3) array or None
        Covariance along the map's axes [m²]; None: trajectory or static target have no standard
        deviations.
    centre_px, centre_cov_px2, distance_m, sd_distance_m, sd_common_distance_m
        As in the sighting.
    common_m : (3, k) array or None
        How one standard deviation of each of k errors that all points share moves this one,
        along the map's axes [m]; k = 4: lever arm x, y, z and synchronisation. It is part of
        `cov_m2`. None: the target stands still, and its points are one point.
    score, ambiguity
        As in the sighting.
    is_checkpoint : bool
        Whether the point is to check an adjustment instead of controlling it.
    flag : Flag or None
        What does not fit a smooth flight; None: nothing, or it could not be examined.
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
        """Share (3, 3) of `cov_m2` that is one error in all points [m²]."""
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
        Why it is not known where the target was, or why the point is left out.
    """

    frame: str
    target: str
    reason: NoPosition | SkipReason


def build_gcps(
    sightings: Sequence[Sighting], target_positions: TargetPositions, camera: Camera
) -> tuple[tuple[Gcp, ...], tuple[SkippedSighting, ...]]:
    """Place every sighting on the ground.

    Parameters
    ----------
    sightings : sequence of Sighting
        In the frames' order.
    camera : Camera
        For the rolling shutter.

    Returns
    -------
    gcps : tuple of Gcp
        In the sightings' order.
    skipped : tuple of SkippedSighting
        What could not be placed, and why.

    Raises
    ------
    KgcpError
        As `TargetPositions.positions`, or if a static target has the id of a moving one's point.
    """
    first = [sighting for sighting in sightings if sighting.instance == 0]
    times = [sighting.row_time_s(camera) for sighting in first]
    positions = target_positions.positions([sighting.target for sighting in first], times)
    skipped = [
        SkippedSighting(sighting.frame, sighting.target, SkipReason.SECOND_PLATE)
        for sighting in sightings
        if sighting.instance > 0
    ]
    placed = []
    for sighting, time_s, position in zip(first, times, positions, strict=True):
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
    """Check that points of one id are one point.

    Raises
    ------
    KgcpError
        If two of them are at different places.
    """
    first: dict[str, Gcp] = {}
    for point in gcps:
        other = first.setdefault(point.id, point)
        if np.allclose(point.position_map, other.position_map, rtol=_SAME_PLACE, atol=1e-9):
            continue
        where = f"in {other.frame} and {point.frame}"
        if point.target != other.target:
            raise KgcpError(
                f"{point.id!r} is a static target and the point of a moving one {where};"
                " give the static target another name in flight.toml"
            )
        raise KgcpError(
            f"target {point.id!r} stands at different places {where};"
            " give one of them another name, or correct position_m"
        )


def flight_prefix(name: str) -> str:
    """Return a flight's name as used in ids and paths: letters, digits, point and hyphen."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_.") or "flight"


def with_flight_name(gcps: Sequence[Gcp], name: str) -> tuple[Gcp, ...]:
    """Return points of which the ids of moving ones begin with the flight's name.

    Those of static targets remain: they are the same points in all flights.
    """
    prefix = flight_prefix(name)
    return tuple(
        point if point.id == point.target else replace(point, id=f"{prefix}-{point.id}")
        for point in gcps
    )


def transform_gcps(gcps: Sequence[Gcp], transform: CrsTransform) -> tuple[Gcp, ...]:
    """Return the points with positions and covariances on another map.

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
