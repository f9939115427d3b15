"""Ground control points: computed from a flight and its detections, and written to files."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kgcp.errors import KgcpError, KgcpWarning, SettingError
from kgcp.georef.camera_priors import CameraPrior, camera_priors
from kgcp.georef.gcp import Gcp, SkippedSighting, SkipReason, build_gcps, transform_gcps
from kgcp.georef.local_frame import CrsTransform
from kgcp.georef.selection import Selection, exclude, explain_empty_selection, select
from kgcp.georef.sighting import Attempt, Sighting
from kgcp.georef.target_positions import Vehicle
from kgcp.io.exporters.formats import DEFAULT_FORMATS, FORMATS
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.weights import MARK_FLOOR_PX
from kgcp.io.exporters.write import export
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, require_flight
from kgcp.io.tables.consistency import remove_consistency, write_consistency
from kgcp.io.tables.detections import read_attempts
from kgcp.io.tables.gcps import GCP_COLUMNS, gcp_row
from kgcp.io.tables.parquet import write_table
from kgcp.io.tables.provenance import derived_provenance
from kgcp.pipeline.exclude import warn_of_unknown
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.flight_inputs import FlightInputs, missing_frames, naming_causes
from kgcp.pipeline.workspace import DETECTIONS, results_folder
from kgcp.quality.checks.doubt import Doubt, ranked
from kgcp.quality.checks.place import check_export_crs
from kgcp.quality.consistency import Consistency
from kgcp.quality.number_text import rounded
from kgcp.settings import require_kind

POINTS_TABLE = "kgcps.parquet"
"""File name of the points in the results folder."""

_DEFAULT_SELECTION = Selection()


@dataclass(frozen=True, slots=True, eq=False)
class GcpSet:
    """All points of an export, in one CRS.

    Attributes
    ----------
    flight : Flight
        The flight of the points.
    crs : str
        CRS of all coordinates.
    gcps : tuple of Gcp
    skipped : tuple of SkippedSighting
        Sightings without a point, or whose point was not selected.
    camera_priors : tuple of CameraPrior
        Positions and attitudes of the camera, computed from plate and vehicle.
    vehicle : Vehicle or None
        None if no target is carried by a vehicle.
    consistency : Consistency or None
        None if there are no reference poses, or too few frames to compare.
    provenance : mapping of str
        Metadata of the points' tables: what the points were made from.
    doubts : tuple of Doubt
        What does not fit, with its likely cause; grave doubts come first.
    """

    flight: Flight
    crs: str
    gcps: tuple[Gcp, ...]
    skipped: tuple[SkippedSighting, ...]
    camera_priors: tuple[CameraPrior, ...]
    vehicle: Vehicle | None
    consistency: Consistency | None
    provenance: Mapping[str, str]
    doubts: tuple[Doubt, ...] = ()

    def to_dataframe(self) -> pd.DataFrame:
        """Return the points as a table with the columns of `kgcps.parquet`."""
        names = [column.name for column in GCP_COLUMNS]
        return pd.DataFrame([gcp_row(point) for point in self.gcps], columns=names)


@single_threaded()
def make_gcps(
    flight: Flight,
    detections: Path | str | None = None,
    *,
    selection: Selection = _DEFAULT_SELECTION,
    crs: str | None = None,
) -> GcpSet:
    """Make ground control points from a flight's detections and its vehicle's trajectory.

    Reference poses are mostly computed later, with the points: it is not an error if their file
    does not exist yet.

    Parameters
    ----------
    detections : Path, optional
        The table that `detect_flight` wrote; by default that of the flight's results folder.
    crs : str, optional
        CRS of the points, in any form that pyproj reads; by default that of the flight.

    Raises
    ------
    KgcpError
        If nothing was measured, no position can be computed, a file is unreadable, or a CRS is
        unusable.
    """
    require_flight(flight)
    require_kind("selection", selection, Selection)
    if crs is not None:
        require_kind("crs", crs, str, "give a text such as 'EPSG:25832'")
    table = results_folder(flight.folder) / DETECTIONS if detections is None else Path(detections)
    attempts = read_attempts(table, flight)
    sightings, excluded = _sightings(table, attempts, selection)
    data = FlightData(flight, sorted({attempt.frame for attempt in attempts}))
    inputs = FlightInputs.detected(flight, data, attempts)
    with naming_causes(inputs.plausibility):
        target_positions = data.target_positions
        placed, absent = build_gcps(sightings, target_positions, flight.camera)
    if not placed and {each.reason for each in absent} == {SkipReason.SECOND_PLATE}:
        raise KgcpError(
            f"{table}: every frame with a target shows several plates of its code, so that none is"
            " known to be the target; give each vehicle a code of its own, or cover the other"
            " plates in the frames"
        )
    local_frame = target_positions.local_frame
    gcps, unwanted = select(placed, sightings, local_frame, flight.camera, selection)
    if placed and not gcps:
        raise KgcpError(explain_empty_selection(placed, unwanted, selection))
    consistency, doubts = inputs.compared(sightings)
    if crs is not None and gcps:
        time_s = next((point.time_s for point in gcps if point.time_s is not None), None)
        transform = CrsTransform.to(crs, local_frame, gcps[0].position_map, time_s=time_s)
        gcps, local_frame = transform_gcps(gcps, transform), transform.target
        places = np.array([point.position_map for point in gcps])
        doubts = (*doubts, *check_export_crs(local_frame.crs, places))
    return GcpSet(
        flight=flight,
        crs=local_frame.crs,
        gcps=gcps,
        skipped=(*excluded, *absent, *unwanted),
        camera_priors=camera_priors(gcps, sightings, target_positions, local_frame),
        vehicle=target_positions.vehicle,
        consistency=consistency,
        provenance=derived_provenance(
            flight,
            table,
            {"selection": asdict(selection), "crs": crs},
            has_reference=data.has_reference,
        ),
        doubts=ranked((*doubts, *missing_frames(flight, sightings))),
    )


def _sightings(
    table: Path, attempts: Sequence[Attempt], selection: Selection
) -> tuple[Sequence[Sighting], Sequence[SkippedSighting]]:
    """Return the sightings to make points from, and those that the user excluded.

    Raises
    ------
    KgcpError
        If there are no sightings to make points from.
    """
    measured = [attempt.sighting for attempt in attempts if attempt.sighting is not None]
    if not measured:
        raise KgcpError(
            f"{table}: no target was measured in any frame;"
            " see the reasons that 'kgcp detect' gives"
        )
    warn_of_unknown(selection.excluded, table)
    sightings, excluded = exclude(measured, selection.excluded)
    if not sightings:
        raise KgcpError(f"{table}: all {len(measured)} sightings are excluded; exclude fewer")
    return sightings, excluded


def accuracy_text(gcps: Sequence[Gcp]) -> str:
    """Return the accuracy of points in words; empty if no standard deviations are known."""
    variances = [np.diag(point.cov_m2) for point in gcps if point.cov_m2 is not None]
    if not variances:
        return ""
    sds_cm = 100.0 * np.sqrt(variances)
    usual = "/".join(map(rounded, np.median(sds_cm, axis=0).tolist()))
    worst = rounded(float(sds_cm.max()))
    return f"standard deviations of x/y/z: {usual} cm (median), at worst {worst} cm"


@single_threaded()
def export_gcps(
    gcp_set: GcpSet,
    formats: Sequence[str] = DEFAULT_FORMATS,
    folder: Path | str | None = None,
    *,
    mark_floor_px: float = MARK_FLOOR_PX,
    image_extensions: bool = True,
) -> list[Path]:
    """Write the files of some formats, and return their paths.

    A `kgcps.parquet` of other points in the folder, from an earlier `kgcp export-gcp`, stays there,
    with a `KgcpWarning`.

    Parameters
    ----------
    formats : sequence of str
        Names of formats, as in `kgcp export-gcp --list-formats`.
    folder : Path, optional
        Folder of the files; by default the flight's results folder.
    mark_floor_px : float
        Least standard deviation of a mark in the files for other programs [px].
    image_extensions : bool
        Whether image names have their extension, in formats whose packages may omit it.

    Raises
    ------
    KgcpError
        If a format is unknown or cannot hold the points, there are none, or a file cannot be
        written.
    """
    if isinstance(formats, str):
        raise SettingError("formats", f"is the text {formats!r}", "give a list of names")
    folder = results_folder(gcp_set.flight.folder) if folder is None else Path(folder)
    points = MapPoints(
        gcp_set.crs,
        gcp_set.gcps,
        gcp_set.flight.camera,
        gcp_set.camera_priors,
        mark_floor_px,
        image_extensions,
    )
    written = write_formats(points, formats, folder)
    _warn_of_other_points(folder / POINTS_TABLE, gcp_set)
    return written


def _warn_of_other_points(table: Path, gcp_set: GcpSet) -> None:
    """Warn if there is a table of an earlier export that was made from other inputs."""
    try:
        metadata = pq.read_schema(table).metadata or {}
    except (OSError, pa.ArrowException):  # no table, or a damaged one
        return
    if metadata.get(b"kgcp.digests", b"").decode() != gcp_set.provenance["digests"]:
        warnings.warn(
            f"{table}: is of an earlier export, made from other inputs than the files written now;"
            " delete it, or repeat 'kgcp export-gcp'",
            KgcpWarning,
            stacklevel=4,  # the caller of `export_gcps`, which is decorated
        )


def write_formats(points: MapPoints, formats: Sequence[str], folder: Path) -> list[Path]:
    """Write the files of some formats, and return their paths.

    Raises
    ------
    KgcpError
        As `export_gcps`.
    """
    formats = tuple(formats)  # of a generator, too
    unknown = [name for name in formats if name not in FORMATS]
    if unknown:
        raise KgcpError(f"format {unknown[0]!r}: is unknown; give one of {', '.join(FORMATS)}")
    return [path for name in dict.fromkeys(formats) for path in export(points, name, folder)]


def write_gcps(gcp_set: GcpSet, folder: Path) -> list[Path]:
    """Write `kgcps.parquet`, and the files of the consistency if there are reference poses.

    Otherwise the files of the consistency from an earlier export are removed.

    Raises
    ------
    KgcpError
        If a file cannot be written.
    """
    about = gcp_set.provenance
    table = folder / POINTS_TABLE
    write_table(table, GCP_COLUMNS, map(gcp_row, gcp_set.gcps), {**about, "crs": gcp_set.crs})
    if gcp_set.consistency is None:
        remove_consistency(folder)
        return [table]
    return [table, *write_consistency(folder, gcp_set.consistency, gcp_set.doubts, about)]
