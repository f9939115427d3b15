"""Writers of KGCPs, one module per receiving package.

A module offers `files(points: MapPoints) -> Mapping[str, str | bytes]`, paths below the results'
folder and what they hold, and has one entry in `FORMATS`; it is imported when its format is asked
for. Where a package needs several files they have a folder of their own, with a HOWTO.txt.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kgcp.io.exporters.points import MapPoints


@dataclass(frozen=True, slots=True)
class Format:
    """One format of the command line.

    Attributes
    ----------
    module : str
        Below this package.
    files : tuple of str
        What it writes, below the results' folder; in brackets: only where there is something.
    description : str
        One line.
    """

    module: str
    files: tuple[str, ...]
    description: str


FORMATS: Mapping[str, Format] = {
    "csv": Format("plain_csv", ("kgcps.csv",), "all that kgcp knows about every point"),
    "odm": Format(
        "odm",
        ("gcp_list.txt", "odm/HOWTO.txt", "[odm/geo.txt]"),
        "OpenDroneMap: points; camera positions",
    ),
    "opensfm": Format(
        "opensfm",
        (
            "opensfm/ground_control_points.json",
            "opensfm/HOWTO.txt",
            "[opensfm/exif_overrides.json]",
        ),
        "OpenSfM: points in WGS 84; camera positions",
    ),
    "metashape": Format(
        "metashape",
        (
            "metashape/markers.csv",
            "metashape/markers.xml",
            "metashape/scale_bars.csv",
            "metashape/add_scale_bars.py",
            "metashape/HOWTO.txt",
            "[metashape/cameras.csv]",
        ),
        "Agisoft Metashape: markers with accuracies, distances as scale bars; cameras",
    ),
    "pix4d": Format(
        "pix4d",
        ("pix4d/gcps.csv", "pix4d/marks.csv", "pix4d/HOWTO.txt", "[pix4d/checkpoints.csv]"),
        "Pix4D: points and marks with accuracies",
    ),
    "opf": Format(
        "opf",
        (
            "opf/project.opf",
            "opf/camera_list.json",
            "opf/input_control_points.json",
            "opf/HOWTO.txt",
        ),
        "Open Photogrammetry Format: points and marks with standard deviations",
    ),
    "micmac": Format(
        "micmac",
        ("micmac/gcps.xml", "micmac/marks.xml", "micmac/HOWTO.txt"),
        "MicMac v1: points and marks with uncertainties, in a local frame",
    ),
    "mmvii": Format(
        "mmvii",
        (
            "mmvii/MesGCP-kgcp.xml",
            "mmvii/CurSysCo.xml",
            "mmvii/MesIm-*.xml",
            "mmvii/kgcp.obs",
            "mmvii/HOWTO.txt",
        ),
        "MMVII: points and marks with covariances, distances, in a local frame",
    ),
    "colmap": Format(
        "colmap",
        (
            "colmap/pose_priors.csv",
            "colmap/reference.txt",
            "colmap/add_pose_priors.py",
            "colmap/HOWTO.txt",
        ),
        "COLMAP: camera positions with covariances, in a local frame",
    ),
    "camera-priors": Format(
        "camera_priors",
        ("camera_priors/camera_priors.csv", "camera_priors/HOWTO.txt"),
        "position and attitude of the camera with their covariance",
    ),
    "geojson": Format("geojson", ("geojson/kgcps.geojson", "geojson/HOWTO.txt"), "a map in WGS 84"),
    "geopackage": Format(
        "geopackage",
        ("geopackage/kgcps.gpkg", "geopackage/HOWTO.txt"),
        "a map in the CRS of the points",
    ),
}
"""By the name on the command line."""

DEFAULT_FORMATS = ("csv", "odm")


def export(points: MapPoints, name: str, folder: Path) -> list[Path]:
    """Write the files of one format; return their paths.

    Raises
    ------
    KgcpError
        If there are no points, the format cannot hold them, or a file cannot be written.
    """
    from kgcp.errors import KgcpError
    from kgcp.io.files.atomic import write_all

    if not points.kgcps:
        raise KgcpError(f"{name}: no point is left to write; select less strictly")
    module = import_module(f"{__name__}.{FORMATS[name].module}")
    files: Mapping[str, str | bytes] = module.files(points)
    contents = {
        folder / file_name: content.encode("utf-8") if isinstance(content, str) else content
        for file_name, content in files.items()
    }
    write_all(contents)
    _remove_stale(folder, FORMATS[name].files, set(contents))
    return [*contents]


def _remove_stale(folder: Path, patterns: tuple[str, ...], written: set[Path]) -> None:
    """Remove what the format wrote earlier and does not now: packages read whole folders."""
    for pattern in patterns:
        for path in folder.glob(pattern.strip("[]")):
            if path not in written:
                path.unlink()


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
