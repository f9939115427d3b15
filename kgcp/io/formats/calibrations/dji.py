"""DJI's DewarpData: in the XMP of an image, in an XMP sidecar, or the bare text.

By the manual of the Matrice 4: `date;fx,fy,cx,cy,k1,k2,p1,p2,k3`, of which cx and cy
count from the middle of the photo, and the coefficients are OpenCV's.
"""

from __future__ import annotations

import re

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry
from kgcp.io.images.header import image_size

_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_DATA = rf"(?:[^;<>\"',]{{0,40}};\s*)?(?:{_NUMBER}\s*,\s*){{8}}{_NUMBER}"
_TAG = re.compile(r"DewarpData\s*(?:=\s*[\"']|>)\s*([^\"'<]*)")
_BARE = re.compile(rf"({_DATA})")
_FLAG = re.compile(r"DewarpFlag\s*(?:=\s*[\"']|>)\s*([0-9]+)")


def matches(file: ForeignFile) -> bool:
    """Whether the content has a DewarpData, or is one."""
    return _TAG.search(file.text) is not None or _BARE.fullmatch(file.text.strip()) is not None


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera."""
    dewarp_data = _TAG.search(file.text) or _BARE.fullmatch(file.text.strip())
    if dewarp_data is None:
        raise file.error("has no DewarpData", "name an image as the camera wrote it")
    flag = _FLAG.search(file.text)
    if flag is not None and flag[1].strip("0"):
        raise file.error(
            "is dewarped already (DewarpFlag), so that its DewarpData describes another image",
            "switch dewarping off in the camera, or calibrate these images",
        )
    numbers = dewarp_data[1].rpartition(";")[2].replace(",", " ")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = file.numbers(numbers, 9, "DewarpData")

    def convert(width: int, height: int) -> Camera:
        x, y = 0.5 * (width - 1) + cx, 0.5 * (height - 1) + cy
        return Camera(width, height, fx, fy, x, y, k1, k2, p1, p2, k3)

    return (Entry("", _image_size(file), convert),)


def _image_size(file: ForeignFile) -> tuple[int, int] | None:
    """Return width and height of the image [px]; None where the file is not an image."""
    with file.path.open("rb") as stream:
        return image_size(stream)
