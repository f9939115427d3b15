"""The group camera of visiona's configuration files: OpenCV's model with one focal length.

camera = { f = 761.0; pp = [322.0, 231.0]; TD = [p1, p2]; RD = [k1, k2, k3]; };
"""

from __future__ import annotations

import re

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry
from kgcp.io.formats.visiona_target import visiona_settings

_GROUP = re.compile(r"\bcamera\s*[=:]\s*\{[^}]{0,2000}\bpp\s*[=:]\s*[\[(]")


def matches(file: ForeignFile) -> bool:
    """Whether the content has a group camera with a principal point."""
    return _GROUP.search(file.text) is not None


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera, which does not know the size of its images."""
    camera = visiona_settings(file).child("camera")
    focal = camera.number("f")
    cx, cy = camera.vector("pp", 2)
    p1, p2 = camera.vector("TD", 2)
    k1, k2, k3 = camera.vector("RD", 3)

    def convert(width: int, height: int) -> Camera:
        return Camera(width, height, focal, focal, cx, cy, k1, k2, p1, p2, k3)

    return (Entry("", None, convert),)
