"""iTwin Capture (ContextCapture): a block in Bentley's BlocksExchange XML 2.1.

By Bentley's "BlocksExchange XML/XMLZ format" and "CC Orientations": a control point has one
horizontal and one vertical accuracy and measurements in photos; (0, 0) px is the centre of the
upper-left pixel; x and y are easting, northing or longitude, latitude. Only the ratio of focal
length and sensor size counts. The direction of its distortion polynomial is not documented without
doubt: it is left out, and the program estimates it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files as resources
from xml.etree import ElementTree as ET

from kgcp.geometry.camera import Camera
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import (
    MapPoints,
    by_frame,
    by_id,
    decimals,
    deviations,
    labels,
    largest_sd,
    pixel,
)
from kgcp.io.exporters.shared import add_text, well_known_text, xml_text

_FOLDER = "itwin"
_SENSOR_MM = 36.0  # of the longer side; the focal length is in the same proportion
_CODE = re.compile(r"EPSG:\d+(\+\d+)?")
_HOWTO = """\
iTwin Capture Modeler, ContextCapture

Into a block that you have already:
1. Export the block as BlocksExchange XML.
2. python add_to_block.py BLOCK.xml
   writes BLOCK_kgcp.xml: the same block with kgcp's points, without the moving points of an earlier
   export. Photos are found by their file names; those of several flights that have the same name,
   by a folder with the flight's name. The script prints which ones are not in the block. It needs
   Python, and nothing else.
3. Import BLOCK_kgcp.xml as a block, and submit the aerotriangulation with control points.

As a block of its own, with the images that show the target: copy block.xml into the folder of the
images (paths are relative to it) and import it.

Coordinates are in {crs}, x is easting or longitude;
z is {heights}. Choose the
vertical system of the block accordingly. Points kept for checking are check points. Accuracies are
metres. Bentley does not document their unit for a system in feet, nor that of the heights: export
points of such a system in one in metres (kgcp export-gcp --crs).

A moving point is measured in one photo only. iTwin Capture wants three or more control points with
two or more measurements each to orient a block by them: use it with the photos' own positions, or
with static targets besides. It takes one horizontal accuracy, which here is that of the worst
direction, and one vertical; it ignores standard deviations of marks, correlations and distances.
"""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return a block of the images that show a target, and a script that adds it to another.

    Raises
    ------
    KgcpError
        If the CRS has neither a code of EPSG nor a form as well-known text 1.
    """
    script = resources("kgcp.io.exporters").joinpath("scripts/itwin_add_to_block.txt")
    texts = {
        "HOWTO.txt": _HOWTO.format(crs=points.crs, heights=points.heights),
        "block.xml": _block(points),
        "add_to_block.py": script.read_text(encoding="utf-8"),
    }
    return {f"{_FOLDER}/{name}": text for name, text in texts.items()}


def _block(points: MapPoints) -> str:
    root = ET.Element("BlocksExchange", version="2.1")
    system = ET.SubElement(ET.SubElement(root, "SpatialReferenceSystems"), "SRS")
    is_code = _CODE.fullmatch(points.crs)  # else well-known text 1
    definition = points.crs if is_code else well_known_text(points, _FOLDER, "iTwin Capture")
    for tag, text in (("Id", "0"), ("Name", points.crs), ("Definition", definition)):
        add_text(system, tag, text)
    block = ET.SubElement(root, "Block")
    add_text(block, "Name", "kgcp")
    add_text(block, "SRSId", "0")
    photo_ids = {frame: str(number) for number, frame in enumerate(by_frame(points.gcps))}
    group = ET.SubElement(ET.SubElement(block, "Photogroups"), "Photogroup")
    _add_camera(group, points.camera)
    for frame, photo_id in photo_ids.items():
        photo = ET.SubElement(group, "Photo")
        add_text(photo, "Id", photo_id)
        add_text(photo, "ImagePath", frame)
        add_text(photo, "Component", "0")
    controls = ET.SubElement(block, "ControlPoints")
    label = labels(points.gcps, _FOLDER)
    for point_id, rays in by_id(points.gcps).items():
        _add_control_point(controls, label[point_id], points, rays, photo_ids)
    return xml_text(root)


def _add_camera(group: ET.Element, camera: Camera) -> None:
    size = ET.SubElement(group, "ImageDimensions")
    add_text(size, "Width", str(camera.width))
    add_text(size, "Height", str(camera.height))
    add_text(group, "CameraModelType", "Perspective")
    add_text(group, "CameraModelBand", "Visible")
    add_text(group, "SensorSize", f"{_SENSOR_MM:g}")
    pixel_mm = _SENSOR_MM / max(camera.width, camera.height)
    add_text(group, "FocalLength", decimals(0.5 * (camera.fx + camera.fy) * pixel_mm))
    add_text(group, "CameraOrientation", "XRightYDown")
    _add_xy(ET.SubElement(group, "PrincipalPoint"), decimals(camera.cx), decimals(camera.cy))


def _add_control_point(
    controls: ET.Element,
    name: str,
    points: MapPoints,
    rays: list[Gcp],
    photo_ids: Mapping[str, str],
) -> None:
    first = rays[0]
    control = ET.SubElement(controls, "ControlPoint")
    add_text(control, "Name", name)
    add_text(control, "Category", "Full")
    x, y, z = points.xyz(first.position_map)
    position = ET.SubElement(control, "Position")
    _add_xy(position, x, y)
    add_text(position, "z", z)
    add_text(control, "CheckPoint", "true" if first.is_checkpoint else "false")
    if first.cov_m2 is not None:
        add_text(control, "HorizontalAccuracy", decimals(largest_sd(first.cov_m2[:2, :2])))
        add_text(control, "VerticalAccuracy", decimals(float(deviations(first.cov_m2)[2])))
    for ray in rays:
        measurement = ET.SubElement(control, "Measurement")
        add_text(measurement, "PhotoId", photo_ids[ray.frame])
        _add_xy(measurement, *pixel(ray))


def _add_xy(parent: ET.Element, x: str, y: str) -> None:
    add_text(parent, "x", x)
    add_text(parent, "y", y)
