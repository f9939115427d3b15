"""OPF, the Open Photogrammetry Format 1.0 of Pix4D: control points with standard deviations.

By the specification (github.com/Pix4D/opf-spec): coordinates in the CRS's own axis order and,
unless it is geographic, sigmas in its units; three sigmas per point and an accuracy per mark;
(0, 0) px is the corner of the top-left pixel; a project file names the parts. The scene reference
frame brings coordinates of the project's CRS into right-handed metres near 0. Input cameras are
left out: they require the size of a pixel and the range of the grey values, which no flight states.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from urllib.parse import quote
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from pyproj.enums import WktVersion

from kgcp import __version__
from kgcp.geometry.arrays import FloatArray
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
_ROUND_M = 100.0  # the shift of coordinates
_CODE = re.compile(r"[A-Za-z]+:\d+(\+([A-Za-z]+:)?\d+)?")
_HOWTO = """\
OPF, the Open Photogrammetry Format (PIX4Dmatic)

1. Copy the files with the ending .json and project.opf into the folder of the frames: paths of
   images are relative to it.
2. PIX4Dmatic 1.75 or later: create a project by importing project.opf (Pix4D's article "Importing
   and Exporting OPF - PIX4Dmatic" shows the dialog). Camera models and positions come from the
   images; only images that show the target are in the project: add the others.
If it does not accept a project without input cameras, create the project from the images and import
the files of kgcp export-gcp --format pix4d.

project.opf names the files beside it:
  camera_list.json            the images
  input_control_points.json   points in {crs}, in the order of its own
                              axes, z {heights},
                              with three standard deviations each; their marks with accuracies
                              [px]; points kept for checking have is_checkpoint.
  scene_reference_frame.json  the project's CRS; it is missing if the points have degrees, which
                              OPF does not process: export them with kgcp export-gcp --crs

Programs weight marks by their accuracies and points by their sigmas. OPF holds no correlations, and
takes no distances, because its scale constraints join two control points, never a camera.

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
    parts: dict[str, dict[str, object]] = {
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
    if not points.parsed_crs.is_geographic:
        parts["scene_reference_frame"] = _scene_reference_frame(points)
    texts = {f"{name}.json": json.dumps(part, indent=1) + "\n" for name, part in parts.items()}
    texts["project.opf"] = _project(texts)
    texts["HOWTO.txt"] = _HOWTO.format(
        crs=points.crs, heights=points.heights, marks=marks_note(points)
    )
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _gcps(points: MapPoints, camera_ids: Mapping[str, int]) -> list[dict[str, object]]:
    definition, units = _definition(points), points.metres_per_unit
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
    written = points.written_crs
    whole = written if written.is_compound else written.to_3d()
    return whole.to_wkt(WktVersion.WKT2_2019)


def _scene_reference_frame(points: MapPoints) -> dict[str, object]:
    """Return the project's CRS and the way to right-handed metres near 0: scale, swap, shift."""
    scale = points.metres_per_unit
    own: FloatArray = np.array(points.own_axes(points.gcps[0].position_map.tolist()))
    swaps = _is_left_handed(points)
    metres = (own * scale)[[1, 0, 2] if swaps else [0, 1, 2]]
    return {
        "format": "application/opf-scene-reference-frame+json",
        "version": "1.0",
        "crs": {"definition": _definition(points)},
        "base_to_canonical": {
            "scale": scale.tolist(),
            "shift": (-_ROUND_M * np.round(metres / _ROUND_M)).tolist(),
            "swap_xy": swaps,
        },
    }


def _is_left_handed(points: MapPoints) -> bool:
    """Whether the CRS's first two axes and up are left-handed, as north, east, up are."""
    first, second = points.parsed_crs.axis_info[:2]
    if first.direction == second.direction:  # about a pole
        return points.is_north_first
    east_north = {"east": (1, 0), "west": (-1, 0), "north": (0, 1), "south": (0, -1)}
    (a, b), (c, d) = (
        east_north.get(axis.direction, default)
        for axis, default in zip((first, second), ((1, 0), (0, 1)), strict=True)
    )
    return a * d - b * c < 0


def _project(texts: Mapping[str, str]) -> str:
    """Return the project file; its ids follow from the contents."""
    ids = {name.removesuffix(".json"): str(uuid5(NAMESPACE_URL, texts[name])) for name in texts}
    sources = {"input_control_points": [{"id": ids["camera_list"], "type": "camera_list"}]}
    project = {
        "version": "1.0",
        "format": "application/opf-project+json",
        "id": str(uuid5(NAMESPACE_URL, "".join(ids[name] for name in sorted(ids)))),
        "name": "kgcp",
        "description": "Kinematic ground control points",
        "generator": {"name": "kgcp", "version": __version__},
        "items": [
            {
                "id": item_id,
                "type": name,
                "resources": [
                    {
                        "uri": f"{name}.json",
                        "format": f"application/opf-{name.replace('_', '-')}+json",
                    }
                ],
                "sources": sources.get(name, []),
            }
            for name, item_id in ids.items()
        ],
    }
    return json.dumps(project, indent=1) + "\n"
