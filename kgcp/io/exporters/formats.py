"""The formats of `kgcp export-gcp`, by their names on the command line; quick to import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Format:
    """One format of the command line.

    Attributes
    ----------
    files : tuple of str
        What it writes, below the results' folder; in brackets: only where there is something.
    description : str
        One line.
    """

    files: tuple[str, ...]
    description: str


FORMATS: Mapping[str, Format] = {
    "csv": Format(("kgcps.csv",), "all that kgcp knows about every point"),
    "odm": Format(
        ("gcp_list.txt", "odm/HOWTO.txt", "[odm/geo.txt]"),
        "OpenDroneMap: points; camera positions",
    ),
    "opensfm": Format(
        (
            "opensfm/ground_control_points.json",
            "opensfm/HOWTO.txt",
            "[opensfm/exif_overrides.json]",
        ),
        "OpenSfM: points in WGS 84; camera positions",
    ),
    "metashape": Format(
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
        ("pix4d/gcps.csv", "pix4d/marks.csv", "pix4d/HOWTO.txt", "[pix4d/checkpoints.csv]"),
        "Pix4D: points and marks with accuracies",
    ),
    "opf": Format(
        (
            "opf/project.opf",
            "opf/camera_list.json",
            "opf/input_control_points.json",
            "opf/HOWTO.txt",
        ),
        "Open Photogrammetry Format: points and marks with standard deviations",
    ),
    "micmac": Format(
        ("micmac/gcps.xml", "micmac/marks.xml", "micmac/HOWTO.txt"),
        "MicMac v1: points and marks with uncertainties, in a local frame",
    ),
    "mmvii": Format(
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
        (
            "colmap/pose_priors.csv",
            "colmap/reference.txt",
            "colmap/add_pose_priors.py",
            "colmap/HOWTO.txt",
        ),
        "COLMAP: camera positions with covariances, in a local frame",
    ),
    "camera-priors": Format(
        ("camera_priors/camera_priors.csv", "camera_priors/HOWTO.txt"),
        "position and attitude of the camera with their covariance",
    ),
    "geojson": Format(("geojson/kgcps.geojson", "geojson/HOWTO.txt"), "a map in WGS 84"),
    "geopackage": Format(
        ("geopackage/kgcps.gpkg", "geopackage/HOWTO.txt"),
        "a map in the CRS of the points",
    ),
}
"""By the name on the command line."""

DEFAULT_FORMATS = ("csv", "odm")
