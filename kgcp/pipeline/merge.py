"""Merge of the points of several flights into one set, for one block."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.gcp import Gcp, SkippedSighting, check_ids, flight_prefix, with_flight_name
from kgcp.io.exporters.formats import DEFAULT_FORMATS
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.weights import MARK_FLOOR_PX
from kgcp.io.tables.consistency import remove_consistency
from kgcp.io.tables.gcps import GCP_COLUMNS, gcp_row
from kgcp.io.tables.parquet import write_table
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.export import GcpSet, write_formats

OF_ONE_CAMERA = frozenset({"itwin", "opensfm"})
"""Formats whose files contain one camera, or depend on the size of its frames."""


@dataclass(frozen=True, slots=True, eq=False)
class MergedGcps:
    """The points of several flights, in one CRS and with unique ids.

    Names of frames are the flight's name and the path below its frames folder, `north/1.jpg`.
    Ids of moving points begin with the flight's name; a static target that several flights have
    seen is one point.
    """

    parts: tuple[GcpSet, ...]  # the points of each flight
    crs: str  # of all coordinates
    gcps: tuple[Gcp, ...]
    skipped: tuple[SkippedSighting, ...]
    camera_priors: tuple[CameraPrior, ...]

    @property
    def has_one_camera(self) -> bool:
        """Whether all flights have the same camera."""
        return all(part.flight.camera == self.parts[0].flight.camera for part in self.parts)


def merge_gcps(parts: Sequence[GcpSet]) -> MergedGcps:
    """Merge the points of flights.

    Raises
    ------
    KgcpError
        If flights have the same name or different CRS, or if static targets with the same name have
        different positions.
    """
    _check_names(parts)
    _check_crs(parts)
    gcps = tuple(
        replace(point, frame=_frame(part, point.frame))
        for part in parts
        for point in with_flight_name(part.gcps, part.flight.name)
    )
    check_ids(gcps)
    return MergedGcps(
        tuple(parts),
        parts[0].crs,
        gcps,
        tuple(
            replace(each, frame=_frame(part, each.frame)) for part in parts for each in part.skipped
        ),
        tuple(
            replace(prior, frame=_frame(part, prior.frame))
            for part in parts
            for prior in part.camera_priors
        ),
    )


def _frame(part: GcpSet, frame: str) -> str:
    return f"{flight_prefix(part.flight.name)}/{frame}"


def _check_names(parts: Sequence[GcpSet]) -> None:
    counts = Counter(flight_prefix(part.flight.name) for part in parts)
    name, count = counts.most_common(1)[0]
    if count > 1:
        folders = [
            str(part.flight.folder) for part in parts if flight_prefix(part.flight.name) == name
        ]
        raise KgcpError(
            f"{' and '.join(folders)} are both named {name!r}; give each flight another name in"
            " its flight.toml"
        )


def _check_crs(parts: Sequence[GcpSet]) -> None:
    for part in parts:
        if part.crs != parts[0].crs:
            raise KgcpError(
                f"the flights {parts[0].flight.name!r} and {part.flight.name!r} have different CRS"
                f" ({parts[0].crs} and {part.crs}); name the CRS of all points",
                option="crs",
            )


@single_threaded()
def export_merged(
    merged: MergedGcps,
    formats: Sequence[str] = DEFAULT_FORMATS,
    *,
    folder: Path,
    mark_floor_px: float = MARK_FLOOR_PX,
    image_extensions: bool = True,
) -> list[Path]:
    """Write the files of some formats, and return their paths; see `export_gcps`.

    Raises
    ------
    KgcpError
        As `export_gcps`, and for a format that holds one camera if the flights have several.
    """
    for name in formats:
        if name in OF_ONE_CAMERA and not merged.has_one_camera:
            raise KgcpError(
                f"{name}: holds one camera, and the flights have several; export each flight on its"
                " own, or leave this format out"
            )
    points = MapPoints(
        merged.crs,
        merged.gcps,
        merged.parts[0].flight.camera,
        merged.camera_priors,
        mark_floor_px,
        image_extensions,
        merged.has_one_camera,
    )
    return write_formats(points, formats, folder)


def write_merged(merged: MergedGcps, folder: Path) -> list[Path]:
    """Write one `kgcps.parquet` for all flights, and remove the consistency of an earlier export.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    table = folder / "kgcps.parquet"
    about = {part.flight.name: dict(part.provenance) for part in merged.parts}
    first = merged.parts[0].provenance
    shared = {key: first[key] for key in ("schema_version", "version")}
    metadata = {**shared, "crs": merged.crs, "flights": json.dumps(about)}
    write_table(table, GCP_COLUMNS, map(gcp_row, merged.gcps), metadata)
    remove_consistency(folder)
    return [table]
