"""Agisoft Metashape: tables of markers, marks, distances and cameras, and a script that sets them.

By the reference of the Python API 2 (Marker, Scalebar, Camera.Reference, CoordinateSystem): x is
easting or longitude; (0, 0) px is the corner of the top-left pixel, since a centred principal point
is half the width. markers.xml is for those who cannot run scripts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.resources import files as resources
from pathlib import PurePosixPath
from xml.etree import ElementTree as ET

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.camera_priors import CameraPrior, opk_covs, opk_deg
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import (
    CORNER_PX,
    MapPoints,
    by_frame,
    by_id,
    decimals,
    deviations,
    image_names,
    labels,
    pixel,
)
from kgcp.io.exporters.shared import focal_length_note, marks_note, well_known_text, xml_text

_FOLDER = "metashape"
_HOWTO = """\
Agisoft Metashape (Professional)

1. Add the photos to a chunk. Align them now or later.
2. Tools > Run Script: import_into_metashape.py. It reads the CSV files beside it and sets
   - the markers, their coordinates in {crs}
     and their accuracies; z is {heights}.
     Points kept for checking are not enabled: Metashape shows their errors;
   - their projections in the photos. Labels may have the extension or not. Photos of several
     flights that have the same name are told apart by a folder with the flight's name;
   - a scale bar from every marker to the camera that saw it, with its length and accuracy;
   - the accuracy of marker projections, of which Metashape has one for all: {mark_px} px, the RMS
     of these. It concerns also other markers of the chunk;
   - positions and angles of cameras, if cameras.csv is here, where the photos have none of their
     own. They come from the plate and its vehicle's attitude and are weak.
   The script may be run again, after another export: moving points and scale bars that are no
   longer in the files go. It prints what it has set.
3. Optimise the cameras (Reference > Optimize Cameras).

Every scale bar has the weight of its own accuracy. Metashape ignores correlations.

Without scripts: File > Import > Import Markers: markers.xml (kgcp export-gcp --image-names writes
labels like the chunk's; where images in several folders have the same name, or flights different
cameras, there is no such file);
then Reference > Import Reference: markers.csv, for the accuracies; comma, first row 2, columns
label, x, y, z and three accuracies, coordinate system as above. Scale bars to cameras can only be
set by the script.

{marks}

{focal_length}"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the files of Metashape.

    Raises
    ------
    KgcpError
        If an image's name has a comma or quote, or the CRS has no form that Metashape reads.
    """
    names, are_labels = _names(points)
    label = labels(points.gcps, _FOLDER)
    mark_px = _rms_mark_px(points.gcps)
    texts = {
        "HOWTO.txt": _HOWTO.format(
            crs=points.crs,
            heights=points.heights,
            mark_px=mark_px or "its own",
            marks=marks_note(points),
            focal_length=focal_length_note(points.controls),
        ),
        "markers.csv": _markers(points, label),
        **(
            {"markers.xml": _markers_xml(points, names, label)}
            if are_labels and points.is_one_camera
            else {}
        ),
        "scale_bars.csv": _scale_bars(points.controls, names, label),
        "marks.csv": _marks(points.gcps, names, label),
        "import_into_metashape.py": _script(points, mark_px),
    }
    if points.priors:
        texts["cameras.csv"] = _cameras(points, names)
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _names(points: MapPoints) -> tuple[Mapping[str, str], bool]:
    """Return the names of images, and whether labels can be like them.

    Where images in several folders have the same name, it is their path: the script can tell them
    apart, labels cannot.
    """
    frames, extensions = [point.frame for point in points.gcps], points.image_extensions
    paths = {*map(PurePosixPath, frames)}
    keep_folder = len({path.name if extensions else path.stem for path in paths}) < len(paths)
    names = image_names(frames, _FOLDER, ',"', keep_folder=keep_folder, extensions=extensions)
    return names, not keep_folder


def _table(columns: str, rows: Iterable[Iterable[str]]) -> str:
    return "".join(f"{line}\n" for line in (columns, *map(",".join, rows)))


def _rms_mark_px(gcps: Iterable[Gcp]) -> str:
    """Return the RMS standard deviation of marks along an axis [px]; empty if none is known."""
    traces = [point.centre_cov_px2.trace() for point in gcps if point.centre_cov_px2 is not None]
    return f"{(0.5 * sum(traces) / len(traces)) ** 0.5:.3f}" if traces else ""


def _script(points: MapPoints, mark_px: str) -> str:
    template = resources("kgcp.io.exporters").joinpath("scripts/metashape_import.txt")
    text = template.read_text(encoding="utf-8").replace("@CRS@", repr(_definition(points)))
    return text.replace("@MARK_PX@", mark_px or "None")


def _definition(points: MapPoints) -> str:
    """Return a CRS as Metashape's CoordinateSystem takes it: a code, or well-known text 1."""
    code = None if points.written_crs.is_compound else points.horizontal_epsg
    return well_known_text(points, _FOLDER, "Metashape") if code is None else f"EPSG::{code}"


def _markers(points: MapPoints, label: Mapping[str, str]) -> str:
    def row(point: Gcp) -> tuple[str, ...]:
        sds = ("",) * 3 if point.cov_m2 is None else map(decimals, deviations(point.cov_m2))
        enabled = "0" if point.is_checkpoint else "1"
        return (label[point.id], *points.xyz(point.position_map), *sds, enabled)

    rows = [row(group[0]) for group in by_id(points.gcps).values()]
    return _table("label,x,y,z,accuracy_x_m,accuracy_y_m,accuracy_z_m,enabled", rows)


def _cameras(points: MapPoints, names: Mapping[str, str]) -> str:
    def row(prior: CameraPrior, opk: FloatArray, cov: FloatArray | None) -> tuple[str, ...]:
        sds = ("",) * 6 if cov is None else tuple(map(decimals, deviations(cov)))
        xyz, angles = points.xyz(prior.position_map), map(decimals, opk)
        return (names[prior.frame], *xyz, *sds[:3], *angles, *sds[3:])

    return _table(
        "label,x,y,z,accuracy_x_m,accuracy_y_m,accuracy_z_m,omega_deg,phi_deg,kappa_deg,"
        "accuracy_omega_deg,accuracy_phi_deg,accuracy_kappa_deg",
        map(row, points.priors, opk_deg(points.priors), opk_covs(points.priors)),
    )


def _marks(gcps: Iterable[Gcp], names: Mapping[str, str], label: Mapping[str, str]) -> str:
    rows = ((label[point.id], names[point.frame], *pixel(point, CORNER_PX)) for point in gcps)
    return _table("marker,camera,x_px,y_px", rows)


def _scale_bars(gcps: Iterable[Gcp], names: Mapping[str, str], label: Mapping[str, str]) -> str:
    rows = (
        (
            label[point.id],
            names[point.frame],
            decimals(point.distance_m),
            "" if point.sd_distance_m is None else decimals(point.sd_distance_m),
        )
        for point in gcps
    )
    return _table("marker,camera,distance_m,accuracy_m", rows)


def _markers_xml(points: MapPoints, names: Mapping[str, str], label: Mapping[str, str]) -> str:
    document = ET.Element("document", version="1.2.0")
    chunk = ET.SubElement(document, "chunk")
    sensor = ET.SubElement(ET.SubElement(chunk, "sensors"), "sensor", id="0", type="frame")
    width, height = str(points.camera.width), str(points.camera.height)
    ET.SubElement(sensor, "resolution", width=width, height=height)
    cameras = ET.SubElement(chunk, "cameras")
    camera_ids = {frame: str(number) for number, frame in enumerate(by_frame(points.gcps))}
    for frame, camera_id in camera_ids.items():
        ET.SubElement(cameras, "camera", id=camera_id, label=names[frame], sensor_id="0")
    markers = ET.SubElement(chunk, "markers")
    frames = ET.SubElement(chunk, "frames")
    seen = ET.SubElement(ET.SubElement(frames, "frame", id="0"), "markers")
    for number, (point_id, group) in enumerate(by_id(points.gcps).items()):
        marker = ET.SubElement(markers, "marker", id=str(number), label=label[point_id])
        x, y, z = points.xyz(group[0].position_map)
        enabled = "false" if group[0].is_checkpoint else "true"
        ET.SubElement(marker, "reference", x=x, y=y, z=z, enabled=enabled)
        rays = ET.SubElement(seen, "marker", marker_id=str(number))
        for point in group:
            x, y = pixel(point, CORNER_PX)
            camera_id = camera_ids[point.frame]
            ET.SubElement(rays, "location", camera_id=camera_id, pinned="true", x=x, y=y)
    return xml_text(document)
