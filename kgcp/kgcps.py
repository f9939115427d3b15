"""Kinematic ground control points: sightings in frames, placed by the carrier's trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from kgcp.carrier import Absence, Place, Whereabouts
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.target.sighting import Sighting


@dataclass(frozen=True, slots=True, eq=False)
class Kgcp:
    """One kinematic ground control point: a point of the ground, seen in one frame.

    Attributes
    ----------
    id : str
        `K` and the number of the frame; for a static target its name, in every frame.
    frame, target : str
        As in the sighting.
    time_s : float or None
        When the target's row was exposed, by the trajectory's clock, Unix UTC [s]; None: not
        known, which only a static target can afford.
    position_map : (3,) array
        x, y, z in the flight's CRS.
    cov_m2 : (3, 3) array or None
        Covariance along the map's axes [m²]; None: the trajectory has no standard deviations.
    centre_px, centre_cov_px2, distance_m, sd_distance_m, sd_common_distance_m
        As in the sighting.
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


@dataclass(frozen=True, slots=True)
class Skip:
    """A sighting that did not become a KGCP.

    Attributes
    ----------
    frame, target : str
        As in the sighting.
    reason : Absence or None
        Why it is not known where the target was; None for a second plate of the same code in a
        frame, since only one can be the target.
    """

    frame: str
    target: str
    reason: Absence | None


def build_kgcps(
    sightings: Sequence[Sighting], whereabouts: Whereabouts, camera: Camera
) -> tuple[tuple[Kgcp, ...], tuple[Skip, ...]]:
    """Place every sighting on the ground.

    Parameters
    ----------
    sightings : sequence of Sighting
        In the frames' order.
    whereabouts : Whereabouts
        Of the flight's targets.
    camera : Camera
        For the rolling shutter.

    Returns
    -------
    kgcps : tuple of Kgcp
        In the sightings' order.
    skipped : tuple of Skip
        What could not be placed, and why.

    Raises
    ------
    KgcpError
        As `Whereabouts.places`.
    """
    first = [sighting for sighting in sightings if sighting.instance == 0]
    times = [seen.row_time_s(camera) for seen in first]
    places = whereabouts.places([seen.target for seen in first], times)
    kgcps, skipped = (
        [],
        [Skip(seen.frame, seen.target, None) for seen in sightings if seen.instance > 0],
    )
    for seen, time_s, place in zip(first, times, places, strict=True):
        if isinstance(place, Place):
            kgcps.append(_kgcp(seen, time_s, place, whereabouts))
        else:
            skipped.append(Skip(seen.frame, seen.target, place))
    return tuple(kgcps), tuple(skipped)


def _kgcp(seen: Sighting, time_s: float | None, place: Place, whereabouts: Whereabouts) -> Kgcp:
    frame = whereabouts.frame
    cov_m2 = None
    if place.cov_m2 is not None:
        axes = frame.grid_rotation(place.position_m)
        cov_m2 = axes.T @ place.cov_m2 @ axes
    moves = seen.target not in whereabouts.static
    offset_s = whereabouts.carrier.settings.time_offset_s if whereabouts.carrier else 0.0
    return Kgcp(
        id=f"K{seen.number:04d}" if moves else seen.target,
        frame=seen.frame,
        target=seen.target,
        time_s=None if time_s is None else time_s + offset_s,
        position_map=frame.map_from_enu(place.position_m[None])[0],
        cov_m2=cov_m2,
        centre_px=seen.centre_px,
        centre_cov_px2=seen.centre_cov_px2,
        distance_m=seen.distance_m,
        sd_distance_m=seen.sd_distance_m,
        sd_common_distance_m=seen.sd_common_distance_m,
    )
