"""PIX4Dmatic's CSV of ground control points and of their marks in the images.

By support.pix4d.com 360038397752 and 360035474951: label, two coordinates in the order of the CRS's
own definition, height, horizontal and vertical accuracy, both in the units of the coordinates or,
if these are degrees, in metres; image, label, x, y, accuracy [px], with (0, 0) px in the corner of
the top-left pixel. Neither has a header line.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import (
    CORNER_PX,
    MapPoints,
    by_id,
    decimals,
    deviations,
    image_names,
    known_centre_cov,
    labels,
    largest_sd,
    pixel,
)
from kgcp.io.exporters.shared import marks_note

_FOLDER = "pix4d"
_HOWTO = """\
PIX4Dmatic

1. Import ground control points: gcps.csv, coordinate system {crs},
   z is {heights}: choose it as such, or points and images are
   tens of metres apart. The columns have the axis order of the CRS's own definition:
   {order} first. The two accuracies have the units of the coordinates
   beside them, metres if these are degrees.
   checkpoints.csv, if it is here, has the points kept for checking: import it as check points.
2. Import marks: marks.csv. Image name, label, x, y, accuracy [px]; image directory off or the
   folder that holds the images, zoom level off.

Pix4D takes one horizontal accuracy, which here is that of the worst direction, and a vertical one.
Every mark has the weight of its own accuracy. Pix4D ignores correlations and distances. Whether it
uses points with a mark in a single image is not documented. --format opf writes the same points as
a project, with three standard deviations each.

PIX4Dmapper reads gcps.csv, too (GCP/MTP Manager > Import GCPs). Whether it reads marks.csv is not
known; its points can be marked by hand, in rayCloud.

{marks}
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the files of Pix4D.

    Raises
    ------
    KgcpError
        If an image's name has a comma or quote, two images have the same name, or an image point
        has no deviations.
    """
    checks = [point for point in points.gcps if point.is_checkpoint]
    order = "latitude or northing" if points.is_north_first else "longitude or easting"
    texts = {
        "HOWTO.txt": _HOWTO.format(
            crs=points.crs, heights=points.heights, order=order, marks=marks_note(points)
        ),
        "gcps.csv": _points(points, points.controls),
        "marks.csv": _marks(points),
    }
    if checks:
        texts["checkpoints.csv"] = _points(points, checks)
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _points(points: MapPoints, gcps: Iterable[Gcp]) -> str:
    label = labels(points.gcps, _FOLDER)
    horizontal, _, vertical = points.metres_per_unit
    lines, groups = [], by_id(gcps)
    covs = [group[0].cov_m2 for group in groups.values()]
    is_each_known = all(cov is not None for cov in covs)  # lines of one file are alike
    for (point_id, group), cov in zip(groups.items(), covs, strict=True):
        cells = [label[point_id], *points.own_axes(points.xyz(group[0].position_map))]
        if cov is not None and is_each_known:
            accuracies = largest_sd(cov[:2, :2]) / horizontal, float(deviations(cov)[2]) / vertical
            cells += map(decimals, accuracies)
        lines.append(",".join(cells) + "\n")
    return "".join(lines)


def _marks(points: MapPoints) -> str:
    names = image_names((point.frame for point in points.gcps), _FOLDER, ',"')
    label = labels(points.gcps, _FOLDER)
    lines = []
    for point in points.gcps:
        accuracy = decimals(largest_sd(known_centre_cov(point, _FOLDER)))
        cells = (names[point.frame], label[point.id], *pixel(point, CORNER_PX), accuracy)
        lines.append(",".join(cells) + "\n")
    return "".join(lines)
