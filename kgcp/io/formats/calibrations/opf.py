"""The Open Photogrammetry Format: sensors of calibrated_cameras.json or input_cameras.json.

By opf-spec: the principal point counts from the corner of the top-left pixel; radial R1 R2 R3 and
tangential T1 T2 are OpenCV's k1 k2 k3 and p1 p2 (so Pix4D's own opf2colmap takes them).
"""

from __future__ import annotations

from functools import partial

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile, NamedValues
from kgcp.io.formats.calibrations.entry import CORNER_TO_CENTRE_PX, Entry, unsupported

FILE_FORMATS = ("application/opf-calibrated-cameras+json", "application/opf-input-cameras+json")


def matches(file: ForeignFile) -> bool:
    """Whether the content says that it is one of the two."""
    return isinstance(file.document, dict) and file.document.get("format") in FILE_FORMATS


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the sensors, named by their ids; only input cameras know the size of their images."""
    sensors = NamedValues.of(file, "", file.document).children("sensors")
    return tuple(
        Entry(sensor.text("id"), _size(sensor), partial(_camera, sensor)) for sensor in sensors
    )


def _size(sensor: NamedValues) -> tuple[int, int] | None:
    if "image_size_px" not in sensor:
        return None
    width, height = sensor.vector("image_size_px", 2)
    return int(width), int(height)


def _camera(sensor: NamedValues, width: int, height: int) -> Camera:
    internals = sensor.child("internals")
    model = internals.text("type")
    if model != "perspective":
        raise unsupported(internals.file, f"the type {model!r}", internals.where)
    focal = internals.number("focal_length_px")
    cx, cy = internals.vector("principal_point_px", 2)
    k1, k2, k3 = internals.vector("radial_distortion", 3)
    p1, p2 = internals.vector("tangential_distortion", 2)
    x, y = cx + CORNER_TO_CENTRE_PX, cy + CORNER_TO_CENTRE_PX
    return Camera(width, height, focal, focal, x, y, k1, k2, p1, p2, k3)
