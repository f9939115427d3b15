"""OPF, the Open Photogrammetry Format 1.0 of Pix4D: control points with standard deviations.

By the specification (github.com/Pix4D/opf-spec): coordinates in the CRS's own axis order and,
unless it is geographic, sigmas in its units; three sigmas per point and an accuracy per mark;
(0, 0) px is the corner of the top-left pixel; a project file names the parts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from urllib.parse import quote
from uuid import NAMESPACE_URL, uuid5

from pyproj.enums import WktVersion

from kgcp import __version__
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import (
    CORNER_PX,
    MapPoints,
    by_frame,
    by_id,
    deviations,
    known_centre_cov,
    known_cov,
    largest_sd,
)
from kgcp.io.exporters.shared import marks_note

_FOLDER = "opf"
_CODE = re.compile(r"[A-Za-z]+:\d+(\+([A-Za-z]+:)?\d+)?")
_HOWTO = """\
OPF, the Open Photogrammetry Format (PIX4Dmatic)

project.opf names the two files beside it:
  camera_list.json            the images, as paths relative to the folder of the frames: copy the
                              three files there, or put the images beside them
  input_control_points.json   points in {crs}, in the order of its own
                              axes, z {heights},
                              with three standard deviations each; their marks with accuracies
                              [px]; points kept for checking have is_checkpoint.

Programs weigh marks by their accuracies and points by their sigmas. OPF holds no correlations. Its
scale constraints join two control points and no cameras: the distances find no place in it.

{marks}
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return an OPF project of images and control points.

    Raises
    ------
    KgcpError
        If a point or an image point has no standard deviations.
    """
    camera_ids = {frame: number for number, frame in enumerate(by_frame(points.gcps), start=1)}
    parts = {
        "camera_list": {
            "format": "application/opf-camera-list+json",
            "version": "1.0",
            "cameras": [{"id": camera_ids[frame], "uri": quote(frame)} for frame in camera_ids],
        },
        "input_control_points": {
            "format": "application/opf-input-control-points+json",
            "version": "1.0",
            "gcps": _gcps(points, camera_ids),
            "mtps": [],
        },
    }
    texts = {f"{name}.json": json.dumps(part, indent=1) + "\n" for name, part in parts.items()}
    texts["project.opf"] = _project(texts)
    texts["HOWTO.txt"] = _HOWTO.format(
        crs=points.crs, heights=points.heights, marks=marks_note(points)
    )
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _gcps(points: MapPoints, camera_ids: Mapping[str, int]) -> list[dict[str, object]]:
    definition, units = _definition(points), _metres_per_unit(points)
    return [
        {
            "id": point_id,
            "geolocation": {
                "crs": {"definition": definition},
                "coordinates": points.own_axes(group[0].position_map.tolist()),
                "sigmas": points.own_axes(
                    (deviations(known_cov(group[0], _FOLDER)) / units).tolist()
                ),
            },
            "marks": [_mark(point, camera_ids[point.frame]) for point in group],
            "is_checkpoint": group[0].is_checkpoint,
        }
        for point_id, group in by_id(points.gcps).items()
    ]


def _mark(point: Gcp, camera_id: int) -> dict[str, object]:
    return {
        "camera_id": camera_id,
        "position_px": (point.centre_px + CORNER_PX).tolist(),
        "accuracy": largest_sd(known_centre_cov(point, _FOLDER)),
    }


def _definition(points: MapPoints) -> str:
    """Return code or WKT 2: a code of two axes in feet would make OPF read heights in feet."""
    crs = points.parsed_crs
    is_plain = crs.is_geographic or crs.axis_info[0].unit_conversion_factor == 1.0
    if _CODE.fullmatch(points.crs) and (crs.is_compound or is_plain):
        return points.crs
    whole = crs if crs.is_compound else crs.to_3d()
    return whole.to_wkt(WktVersion.WKT2_2019)


def _metres_per_unit(points: MapPoints) -> list[float]:
    """Return the size of the axes' units, x, y, z [m]; OPF wants metres for a geographic CRS."""
    crs = points.parsed_crs
    if crs.is_geographic:
        return [1.0] * 3
    whole = crs if crs.is_compound else crs.to_3d()
    return [axis.unit_conversion_factor for axis in whole.axis_info]


def _project(texts: Mapping[str, str]) -> str:
    """Return the project file; its ids follow from the contents."""
    ids = {name: str(uuid5(NAMESPACE_URL, text)) for name, text in sorted(texts.items())}
    cameras = {"id": ids["camera_list.json"], "type": "camera_list"}
    project = {
        "version": "1.0",
        "format": "application/opf-project+json",
        "id": str(uuid5(NAMESPACE_URL, "".join(ids.values()))),
        "name": "kgcp",
        "description": "Kinematic ground control points",
        "generator": {"name": "kgcp", "version": __version__},
        "items": [
            {**cameras, "resources": [_resource("camera_list", "camera-list")], "sources": []},
            {
                "id": ids["input_control_points.json"],
                "type": "input_control_points",
                "resources": [_resource("input_control_points", "input-control-points")],
                "sources": [cameras],
            },
        ],
    }
    return json.dumps(project, indent=1) + "\n"


def _resource(name: str, kind: str) -> dict[str, str]:
    return {"uri": f"{name}.json", "format": f"application/opf-{kind}+json"}
