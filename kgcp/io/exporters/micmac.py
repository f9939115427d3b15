"""MicMac v1's XML: points with uncertainties, and their measures in the images.

By MicMac's include/XML_GEN/ParamChantierPhotogram.xml. MicMac adjusts in Cartesian coordinates, so
the points are in a local frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

from kgcp.io.exporters.local_frame import describe_frame, local_points
from kgcp.io.exporters.points import (
    MapPoints,
    by_frame,
    decimals,
    deviations,
    image_names,
    known_centre_cov,
    known_cov,
    labels,
    largest_sd,
    pixel,
)
from kgcp.io.exporters.shared import add_text, marks_note, xml_text

_FOLDER = "micmac"
_HOWTO = """\
MicMac v1 (mm3d)

  mm3d Campari ".*JPG" Ori-In Ori-Out GCP=[gcps.xml,1,marks.xml,1]

gcps.xml has the points with the standard deviations of their three coordinates (Incertitude),
marks.xml their image points with pointing precision in pixels (PrecPointe); the factors 1 and 1 of
Campari multiply both, and their inverse squares are the weights. Pixel (0, 0) is the centre of the
top-left pixel.

GCPBascule needs points that are seen in two or more images, which moving points are not: bring
the block into the frame by camera positions (CenterBascule) or by classic points first. All that
goes into one adjustment must be in the same frame:

{frame}
MicMac v1 ignores distances and correlations. Points kept for checking are not in the files.

{marks}
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the two XML files of MicMac v1.

    Raises
    ------
    KgcpError
        If an image's name has white space, two images have the same name, or a point or image
        point has no standard deviations.
    """
    label = labels(points.gcps, _FOLDER)
    texts = {
        "gcps.xml": _gcps(points, label),
        "marks.xml": _marks(points, label),
        "HOWTO.txt": _HOWTO.format(frame=describe_frame(points), marks=marks_note(points)),
    }
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _gcps(points: MapPoints, label: Mapping[str, str]) -> str:
    local = local_points(points)
    root = ET.Element("DicoAppuisFlottant")
    for index, point in points.distinct_controls:
        entry = ET.SubElement(root, "OneAppuisDAF")
        add_text(entry, "Pt", " ".join(decimals(value) for value in local.position_m[index]))
        add_text(entry, "NamePt", label[point.id])
        sds = deviations(local.cov_m2(index, known_cov(point, _FOLDER)))
        add_text(entry, "Incertitude", " ".join(map(decimals, sds)))
    return xml_text(root)


def _marks(points: MapPoints, label: Mapping[str, str]) -> str:
    names = image_names((point.frame for point in points.gcps), _FOLDER, r"\s")
    root = ET.Element("SetOfMesureAppuisFlottants")
    for frame, group in by_frame(points.controls).items():
        image = ET.SubElement(root, "MesureAppuiFlottant1Im")
        add_text(image, "NameIm", names[frame])
        for point in group:
            mark = ET.SubElement(image, "OneMesureAF1I")
            add_text(mark, "PrecPointe", decimals(largest_sd(known_centre_cov(point, _FOLDER))))
            add_text(mark, "NamePt", label[point.id])
            add_text(mark, "PtIm", " ".join(pixel(point)))
    return xml_text(root)
