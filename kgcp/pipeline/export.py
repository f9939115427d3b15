"""From a flight and its detections to what `kgcp export-gcp` hands over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import CameraPrior, camera_priors
from kgcp.georef.gcp import Kgcp, Skip, build_kgcps, on_map
from kgcp.georef.local_frame import MapChange
from kgcp.georef.selection import Selection, select
from kgcp.georef.target_positions import Carrier
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.io.tables.detections import read_attempts
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.quality.consistency import Consistency, study_consistency


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """Everything that is handed over, on one map.

    Attributes
    ----------
    crs : str
        Of all coordinates.
    skipped : tuple of Skip
        Sightings that made no point, or one that was not wanted.
    carrier : Carrier or None
        The vehicle.
    consistency : Consistency or None
        None where there are no reference poses, or too few frames to compare.
    """

    crs: str
    kgcps: tuple[Kgcp, ...]
    skipped: tuple[Skip, ...]
    priors: tuple[CameraPrior, ...]
    carrier: Carrier | None
    consistency: Consistency | None


@single_threaded()
def prepare(flight: Flight, detections: Path, wanted: Selection, crs: str | None) -> Delivery:
    """Place, select and bring onto the map `crs` (None: the flight's) what was measured.

    Reference poses are mostly made after the points: a file that is not there yet is no error.

    Raises
    ------
    KgcpError
        If nothing was measured, it cannot be placed, a file is unreadable, or a CRS unusable.
    """
    attempts = read_attempts(detections, flight.targets)
    sightings = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    if not sightings:
        raise KgcpError(
            f"{detections}: no target was measured in any frame;"
            " see the reasons that 'kgcp detect' gives"
        )
    data = FlightData(flight, sorted({attempt.frame for attempt in attempts}))
    whereabouts = data.whereabouts
    frame = whereabouts.frame
    placed, absent = build_kgcps(sightings, whereabouts, flight.camera)
    kgcps, unwanted = select(placed, sightings, frame, flight.camera, wanted)
    consistency = None
    if data.has_reference:
        poses = data.reference_poses
        consistency = study_consistency(sightings, whereabouts, poses, flight.camera)
    if crs is not None and kgcps:
        change = MapChange.to(crs, frame, np.asarray(kgcps[0].position_map))
        kgcps, frame = on_map(kgcps, change), change.target
    return Delivery(
        frame.crs,
        kgcps,
        (*absent, *unwanted),
        camera_priors(kgcps, sightings, whereabouts, frame),
        whereabouts.carrier,
        consistency,
    )
