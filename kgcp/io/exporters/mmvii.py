"""MMVII (MicMac v2): points and measures with covariances, and distances to the cameras.

By MMVII's Bundle_GCP.cpp, ctopodata.cpp and test data: XML of its serialisation, covariances as
their upper triangle, row by row; topographic observations as lines `code from to value sigma`, code
3 a distance, where a name that is not a point is looked up among the cameras. MMVII adjusts in
Cartesian coordinates, so the points are in a local frame. Topographic observations need to know
which (Topo.cpp, cSysCo.cpp): CurSysCo beside the points, `RTL*x*y*z*CRS` for east, north, up over
a point of a CRS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from xml.etree import ElementTree as ET

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.local_frame import describe_frame, local_points, origin_of
from kgcp.io.exporters.points import (
    MapPoints,
    by_frame,
    decimals,
    image_names,
    known_centre_cov,
    known_cov,
    labels,
    pixel,
    upper,
)
from kgcp.io.exporters.shared import add_text, focal_length_note, marks_note, xml_text

_FOLDER = "mmvii"
_DISTANCE = 3
_HOWTO = """\
MMVII (MicMac v2)

Copy MesGCP-kgcp.xml and CurSysCo.xml into MMVII-PhgrProj/ObjCoordWorld/kgcp, the MesIm files into
MMVII-PhgrProj/ObjMesInstr/kgcp (older versions: all of them into PointsMeasure/kgcp), and kgcp.obs
into MMVII-PhgrProj/Topo/kgcp. Then points, marks and distances go into one adjustment:

  MMVII OriBundleAdj ".*JPG" In Out GCP3D=[[kgcp,1]] GCP2D=[[kgcp,1]] TopoDirIn=kgcp

The factor of the points must be positive: only then may distances refer to them. kgcp.obs has one
line per mark: 3 (distance), image, point, metres, standard deviation. CurSysCo.xml says in which
frame all this is, which the distances ask for. Pixel (0, 0) is the centre of the top-left pixel.
The block must be in the points' frame before:

{frame}
MMVII weighs marks by their covariances, distances by their standard deviations, and points by their
three standard deviations. Points kept for checking are not in the files.

{marks}

{focal_length}"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the points, one file of measures per image, and the distances.

    Raises
    ------
    KgcpError
        If an image's name has white space, a quote or an asterisk, two images have the same name,
        or a point or image point has no standard deviations.
    """
    label = labels(points.gcps, _FOLDER)
    names = image_names((point.frame for point in points.gcps), _FOLDER, r'\s*"')
    texts = {
        "HOWTO.txt": _HOWTO.format(
            frame=describe_frame(points),
            marks=marks_note(points),
            focal_length=focal_length_note(points.controls),
        ),
        "MesGCP-kgcp.xml": _gcps(points, label),
        "CurSysCo.xml": _system(points),
        "kgcp.obs": _distances(points.controls, names, label),
    }
    for frame, group in by_frame(points.controls).items():
        texts[f"MesIm-{names[frame]}.xml"] = _measures(names[frame], group, label)
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _document(root: ET.Element) -> str:
    wrapper = ET.Element("Root")
    add_text(wrapper, "Type", '"MMVII_Serialization"')
    add_text(wrapper, "Version", '"0.0.0"')
    ET.SubElement(wrapper, "Data").append(root)
    return xml_text(wrapper)


def _system(points: MapPoints) -> str:
    """Return the definition of the frame; a PROJ string's order of axes is unambiguous."""
    origin = origin_of(points)
    place = f"{origin.longitude}*{origin.latitude}*{origin.height}"
    root = ET.Element("SysCoData")
    add_text(root, "Def", f'"RTL*{place}*+proj=longlat {origin.ellipsoid} +no_defs"')
    return _document(root)


def _triangle(cov: FloatArray) -> str:
    """Return the upper triangle, row by row; variances of micrometres must not vanish."""
    return " ".join(f"{value:.12e}" for value in upper(cov))


def _gcps(points: MapPoints, label: Mapping[str, str]) -> str:
    local = local_points(points)
    root = ET.Element("SetGCP")
    add_text(root, "NameSet", '"kgcp"')
    measures = ET.SubElement(root, "Measures")
    for index, point in points.distinct_controls:
        entry = ET.SubElement(measures, "el")
        add_text(entry, "Name", f'"{label[point.id]}"')
        add_text(entry, "Pt", " ".join(decimals(value) for value in local.position_m[index]))
        add_text(entry, "AdditionalInfo", '""')
        cov = local.cov_m2(index, known_cov(point, _FOLDER))
        add_text(entry, "__Opt__Sigma2", _triangle(cov))
    return _document(root)


def _measures(image: str, group: Iterable[Gcp], label: Mapping[str, str]) -> str:
    root = ET.Element("SetMesIm")
    add_text(root, "NameIm", f'"{image}"')
    measures = ET.SubElement(root, "Measures")
    for point in group:
        entry = ET.SubElement(measures, "el")
        add_text(entry, "Name", f'"{label[point.id]}"')
        add_text(entry, "Pt", " ".join(pixel(point)))
        add_text(entry, "Sigma2", _triangle(known_centre_cov(point, _FOLDER)))
    return _document(root)


def _distances(gcps: Iterable[Gcp], names: Mapping[str, str], label: Mapping[str, str]) -> str:
    lines = ["* distances from projection centres to points: code, image, point, metres, sigma"]
    lines += [
        f"{_DISTANCE} {names[point.frame]} {label[point.id]}"
        f" {decimals(point.distance_m)} {decimals(point.sd_distance_m)}"
        for point in gcps
        if point.sd_distance_m is not None
    ]
    return "\n".join(lines) + "\n"
