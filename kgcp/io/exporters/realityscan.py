"""RealityScan, formerly RealityCapture: ground control and its measurements as CSV.

By RealityScan's help (ground controls import, control point measurements import, customize import
formats): the shipped formats `Name, X (East), Y (North), Alt, X Accuracy, Y Accuracy, Alt Accuracy`
and `Image, Point, X, Y, Accuracy`; commas separate, `#` and `;` begin a comment; pixels count from
the upper-left corner of the image.
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
    known_cov,
    labels,
    largest_sd,
    pixel,
)
from kgcp.io.exporters.shared import marks_note

_FOLDER = "realityscan"
_HOWTO = """\
RealityScan 2, RealityCapture

1. Add the images. Set the project's coordinate system (Workflow > Settings > Coordinate systems) to
   {crs}; z is {heights}.
2. Workflow > Ground Control: ground_control.csv. File format: Name, X (East), Y (North), Alt,
   X Accuracy, Y Accuracy, Alt Accuracy; separator: comma; coordinate system as above.
   checkpoints.csv, if it is here, has the points kept for checking: import it likewise, select its
   points and set their type to Ground Test.
   Accuracies are metres. RealityScan's help does not give their unit for a system in feet, nor that
   of the heights: export points of such a system in one in metres (kgcp export-gcp --crs).
3. Workflow > Import Metadata > Control Points: measurements.csv. File format: Image, Point, X, Y,
   Accuracy; separator: comma. If images are not found, their names lack the extension in your
   project: kgcp export-gcp --image-names without-extension.

RealityScan wants two or more measurements of a point: a static target has them, a moving point has
one only. What a single one does is not documented: check it by ground test points. Every mark has
the weight of its own accuracy [px]. RealityScan ignores correlations. Its distance constraints join
two control points, never a camera, so that it cannot use the distances.

{marks}
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return the files of RealityScan.

    Raises
    ------
    KgcpError
        If a point or a mark has no standard deviations, an image's name has a comma, semicolon,
        quote or `#`, or two images have the same name.
    """
    checks = [point for point in points.gcps if point.is_checkpoint]
    texts = {
        "HOWTO.txt": _HOWTO.format(
            crs=points.crs, heights=points.heights, marks=marks_note(points)
        ),
        "ground_control.csv": _points(points, points.controls),
        "measurements.csv": _measurements(points),
    }
    if checks:
        texts["checkpoints.csv"] = _points(points, checks)
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _points(points: MapPoints, gcps: Iterable[Gcp]) -> str:
    label = labels(points.gcps, _FOLDER)
    lines = ["# name, x (easting or longitude), y, height, their standard deviations [m]"]
    for point_id, group in by_id(gcps).items():
        sds = deviations(known_cov(group[0], _FOLDER))
        cells = (label[point_id], *points.xyz(group[0].position_map), *map(decimals, sds))
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _measurements(points: MapPoints) -> str:
    names = image_names(
        (point.frame for point in points.gcps), _FOLDER, ',;"#', extensions=points.image_extensions
    )
    label = labels(points.gcps, _FOLDER)
    lines = ["# image, point, x, y [px], standard deviation [px]"]
    for point in points.gcps:
        accuracy = decimals(largest_sd(known_centre_cov(point, _FOLDER)))
        cells = (names[point.frame], label[point.id], *pixel(point, CORNER_PX), accuracy)
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"
