"""Points into the files of one format."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from kgcp.errors import KgcpError
from kgcp.io.exporters import (
    camera_priors,
    colmap,
    geojson,
    geopackage,
    itwin,
    metashape,
    micmac,
    mmvii,
    odm,
    opensfm,
    opf,
    pix4d,
    plain_csv,
    realityscan,
)
from kgcp.io.exporters.formats import FORMATS
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.weights import with_floors
from kgcp.io.files.atomic import remove, write_all

_WRITERS: Mapping[str, ModuleType] = {
    "csv": plain_csv,
    "odm": odm,
    "opensfm": opensfm,
    "metashape": metashape,
    "pix4d": pix4d,
    "opf": opf,
    "realityscan": realityscan,
    "itwin": itwin,
    "micmac": micmac,
    "mmvii": mmvii,
    "colmap": colmap,
    "camera-priors": camera_priors,
    "geojson": geojson,
    "geopackage": geopackage,
}


_AS_MEASURED = {"csv", "geojson", "geopackage"}  # for people, not for adjustments: no floors
_OF_CONTROLS = {"odm", "opensfm", "micmac", "mmvii"}  # no check points; no adjustment without any


def export(points: MapPoints, name: str, folder: Path) -> list[Path]:
    """Write the files of one format; return their paths.

    Packages get accuracies with floors, see `kgcp.io.exporters.weights`.

    Raises
    ------
    KgcpError
        If there are no points, the format cannot hold them, or a file cannot be written.
    """
    if not points.gcps:
        raise KgcpError(f"{name}: no points left after selection; relax the limits")
    if name in _OF_CONTROLS and not points.controls:
        raise KgcpError(
            f"{name}: all points are check points, which this format cannot hold; keep some of"
            " them as control points, or use another format"
        )
    if name not in _AS_MEASURED:
        points = replace(points, gcps=with_floors(points.gcps, points.mark_floor_px))
    files: Mapping[str, str | bytes] = _WRITERS[name].files(points)
    contents = {
        folder / file_name: content.encode("utf-8") if isinstance(content, str) else content
        for file_name, content in files.items()
    }
    write_all(contents)
    _remove_stale(folder, FORMATS[name].files, set(contents))
    return [*contents]


def _remove_stale(folder: Path, patterns: tuple[str, ...], written: set[Path]) -> None:
    """Remove files of an earlier export that are not written now: packages read whole folders."""
    for pattern in patterns:
        for path in folder.glob(pattern.strip("[]")):
            if path not in written:
                remove(path)


def not_renewed(folder: Path, written: Iterable[Path]) -> tuple[str, ...]:
    """Return the formats of which an earlier export has left files that were not written now."""
    new = set(written)
    patterns = {
        name: [pattern.strip("[]") for pattern in form.files] for name, form in FORMATS.items()
    }
    return tuple(
        name
        for name, files in patterns.items()
        if any(path not in new for pattern in files for path in folder.glob(pattern))
    )
