"""Pix4D's calibrated_camera_parameters.txt and pix4d_calibrated_internal_camera_parameters.cam.

Pixels count from the corner of the top-left one; radial and tangential coefficients are OpenCV's
k1 k2 k3 and p1 p2. The text has a block of ten lines per image: name and size, camera matrix,
radial, tangential, position, rotation. The .cam gives lengths in millimetres on a sensor whose
size it states; the other .cam, of Inpho, has another model and is refused.
"""

from __future__ import annotations

import re
from functools import partial

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import CORNER_TO_CENTRE_PX, Entry, unsupported

_TEXT_HEAD = re.compile(r"\s*fileName\s+imageWidth\s+imageHeight\b")
_LAST_OF_HEAD = re.compile(r"camera model\b")
_CAM_HEAD = re.compile(r"^[^\S\n]*Pix4D camera calibration file\s+(\S+)", re.MULTILINE)
_SENSOR = re.compile(r"sensor width of\s+([\d.eE+-]+)\s*x\s*([\d.eE+-]+)\s*mm")
_BLOCK_LINES = 10
_COUNTS = (3, 3, 3, 3, 2)  # of numbers in the lines after an image's name

# fx fy cx cy k1 k2 k3 p1 p2
_Parameters = tuple[float, ...]


def matches(file: ForeignFile) -> bool:
    """Whether the content begins like one of the two."""
    return _TEXT_HEAD.match(file.text) is not None or _CAM_HEAD.match(file.text) is not None


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the cameras; in the text, one per set of parameters, named by its first image."""
    if _CAM_HEAD.match(file.text):
        blocks = _CAM_HEAD.split(file.text)[1:]
        return tuple(
            _mm_entry(file, name, block)
            for name, block in zip(blocks[::2], blocks[1::2], strict=True)
        )
    return _image_entries(file)


def _image_entries(file: ForeignFile) -> tuple[Entry, ...]:
    head = next((i for i, (_, row) in enumerate(file.rows) if _LAST_OF_HEAD.match(row)), -1)
    rows = file.rows[head + 1 :]
    if head < 0 or not rows or len(rows) % _BLOCK_LINES:
        raise file.error(
            "is not made of blocks of ten lines per image", "export it from Pix4D again"
        )
    names: dict[tuple[tuple[int, int], _Parameters], str] = {}
    for start in range(0, len(rows), _BLOCK_LINES):
        line, first = rows[start]
        name, *size = first.rsplit(maxsplit=2)
        width, height = file.numbers(" ".join(size), 2, f"line {line}")
        # camera matrix (3 lines), radial, tangential; position and rotation follow
        (fx, skew, cx), (_, fy, cy), _, radial, tangential = (
            file.numbers(row, count, f"line {line}")
            for count, (line, row) in zip(_COUNTS, rows[start + 1 : start + 6], strict=True)
        )
        if skew:
            raise unsupported(file, f"a skew of {skew:g}", f"line {rows[start + 1][0]}")
        parameters = (fx, fy, cx, cy, *radial, *tangential)
        names.setdefault(((int(width), int(height)), parameters), name)
    return tuple(
        Entry(name, size, partial(_camera, parameters))
        for (size, parameters), name in names.items()
    )


def _mm_entry(file: ForeignFile, name: str, block: str) -> Entry:
    where = f"camera {name!r}"
    sensor = _SENSOR.search(block)
    if sensor is None:
        raise file.error_at(where, "does not state its sensor width", "export it from Pix4D again")
    width_mm, height_mm = file.numbers(f"{sensor[1]} {sensor[2]}", 2, where)
    if min(width_mm, height_mm) <= 0.0:
        raise file.error_at(where, "has a sensor of zero size", "export it from Pix4D again")
    values = dict(re.findall(r"^[^\S\n]*([A-Z]\w*)[^\S\n]+(\S+)[^\S\n]*$", block, re.MULTILINE))

    def number(key: str) -> float:
        return file.numbers(values.get(key), 1, f"{where} {key}")[0]

    def convert(width: int, height: int) -> Camera:
        """Return the camera for frames of this size."""
        per_mm = width / width_mm
        if abs(height - per_mm * height_mm) > 1.0:
            raise file.error_at(
                where,
                f"has a sensor of {width_mm:g} x {height_mm:g} mm, which is not of the shape of"
                f" {width} x {height} px",
                "use the calibration of this frame size",
            )
        lengths = [per_mm * number(key) for key in ("F", "F", "Px", "Py")]
        terms = [number(key) for key in ("K1", "K2", "K3", "T1", "T2")]
        return _camera((*lengths, *terms), width, height)

    return Entry(name, None, convert)


def _camera(parameters: _Parameters, width: int, height: int) -> Camera:
    fx, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    x, y = cx + CORNER_TO_CENTRE_PX, cy + CORNER_TO_CENTRE_PX
    return Camera(width, height, fx, fy, x, y, k1, k2, p1, p2, k3)
