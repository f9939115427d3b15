"""Cameras of OpenSfM and OpenDroneMap: cameras.json, camera_models(_overrides).json.

By OpenSfM's geometry.rst and io.py: lengths are in units of the frame's longer side. So they hold
for the original frames even if width and height are those of resized ones. The principal point
counts from the frame's middle, ((w − 1)/2, (h − 1)/2) px from the centre of the top-left pixel;
k1, k2, k3, p1, p2 are OpenCV's. A reconstruction.json holds such cameras, too.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile, NamedValues
from kgcp.io.formats.calibrations.entry import Entry, unsupported

# Models → the distortion terms that they have.
_TERMS = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "p1", "p2", "k3"),
}


def matches(file: ForeignFile) -> bool:
    """Whether the content is an object of cameras with a projection_type, or a reconstruction."""
    if isinstance(file.document, list):
        return bool(file.document) and all(
            isinstance(item, dict) and "cameras" in item and "shots" in item
            for item in file.document
        )
    if not isinstance(file.document, dict):
        return False
    values = list(file.document.values())
    return bool(values) and all(isinstance(v, dict) and "projection_type" in v for v in values)


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the cameras, named by their keys."""
    if isinstance(file.document, list):
        parts = [NamedValues.of(file, f"[{i}]", v) for i, v in enumerate(file.document)]
        groups = [part.child("cameras") for part in parts]
    else:
        groups = [NamedValues.of(file, "", file.document)]
    cameras = {key: group.child(key) for group in groups for key in group.values}
    return tuple(
        Entry(name, _size(camera), partial(_camera, camera), is_relative=True)
        for name, camera in cameras.items()
    )


def _size(camera: NamedValues) -> tuple[int, int] | None:
    width, height = camera.number("width", 0.0), camera.number("height", 0.0)
    return (int(width), int(height)) if width and height else None


def _camera(camera: NamedValues, width: int, height: int) -> Camera:
    """Return the camera for a frame; its lengths are shares of the frame's longer side."""
    model = camera.text("projection_type")
    if model not in _TERMS:
        raise unsupported(camera.file, f"the projection_type {model!r}", camera.where)
    longer_side_px = max(width, height)
    terms: dict[str, Any] = {term: camera.number(term, 0.0) for term in _TERMS[model]}
    fx, fy, cx, cy = (longer_side_px * length for length in _matrix(camera, model))
    x, y = cx + 0.5 * (width - 1), cy + 0.5 * (height - 1)
    return Camera(width, height, fx, fy, x, y, **terms)


def _matrix(camera: NamedValues, model: str) -> tuple[float, float, float, float]:
    if model == "perspective":
        return camera.number("focal"), camera.number("focal"), 0.0, 0.0
    focal_x = camera.number("focal_x")
    focal_y = camera.number("focal_y", focal_x)  # files of ODM may lack it: one focal length
    return focal_x, focal_y, camera.number("c_x"), camera.number("c_y")
