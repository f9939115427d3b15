"""The formats of `kgcp export-gcp`, by their names on the command line; quick to import."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Format:
    """One format of the command line."""

    # what it writes, below the results' folder; in brackets: only if there is something to write
    files: tuple[str, ...]
    description: str


def _in_folder(folder: str, names: str, description: str) -> Format:
    """Return a format whose files have a folder of their own."""
    files = re.sub(r"(\[?)(\S+)", rf"\1{folder}/\2", names).split()
    return Format(tuple(files), description)


FORMATS: Mapping[str, Format] = {
    "csv": Format(("kgcps.csv",), "all that kgcp knows about every point"),
    "odm": _in_folder(
        "odm", "gcp_list.txt HOWTO.txt [geo.txt]", "OpenDroneMap: points; camera positions"
    ),
    "opensfm": _in_folder(
        "opensfm",
        "ground_control_points.json HOWTO.txt [exif_overrides.json]",
        "OpenSfM: points in WGS 84; camera positions",
    ),
    "metashape": _in_folder(
        "metashape",
        "import_into_metashape.py markers.csv marks.csv scale_bars.csv HOWTO.txt"
        " [markers.xml] [cameras.csv]",
        "Agisoft Metashape: one script that sets markers, marks, distances and cameras",
    ),
    "pix4d": _in_folder(
        "pix4d",
        "gcps.csv marks.csv HOWTO.txt [checkpoints.csv]",
        "PIX4Dmatic: points and marks with accuracies",
    ),
    "opf": _in_folder(
        "opf",
        "project.opf camera_list.json input_control_points.json HOWTO.txt"
        " [scene_reference_frame.json]",
        "Open Photogrammetry Format (PIX4Dmatic): points and marks with standard deviations",
    ),
    "realityscan": _in_folder(
        "realityscan",
        "ground_control.csv measurements.csv HOWTO.txt [checkpoints.csv]",
        "RealityScan, RealityCapture: points and marks with accuracies",
    ),
    "itwin": _in_folder(
        "itwin",
        "block.xml add_to_block.py HOWTO.txt",
        "iTwin Capture, ContextCapture: points with accuracies and marks, as a block",
    ),
    "micmac": _in_folder(
        "micmac",
        "gcps.xml marks.xml HOWTO.txt",
        "MicMac v1: points and marks with uncertainties, in a local frame",
    ),
    "mmvii": _in_folder(
        "mmvii",
        "MesGCP-kgcp.xml CurSysCo.xml MesIm-*.xml kgcp.obs HOWTO.txt",
        "MMVII: points and marks with covariances, distances, in a local frame",
    ),
    "colmap": _in_folder(
        "colmap",
        "pose_priors.csv reference.txt add_pose_priors.py HOWTO.txt",
        "COLMAP: camera positions with covariances, in a local frame",
    ),
    "camera-priors": _in_folder(
        "camera_priors",
        "camera_priors.csv HOWTO.txt",
        "position and attitude of the camera with their covariance",
    ),
    "geojson": _in_folder("geojson", "kgcps.geojson HOWTO.txt", "a map in WGS 84"),
    "geopackage": _in_folder(
        "geopackage", "kgcps.gpkg HOWTO.txt", "a map in the CRS of the points"
    ),
}
"""By the name on the command line."""

OF_CAMERAS = frozenset({"colmap", "camera-priors"})
"""Formats that hold positions of the camera and no points."""

DEFAULT_FORMATS = ("csv", "odm")
