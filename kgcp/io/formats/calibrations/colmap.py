"""COLMAP's cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS….

By COLMAP's doc/cameras.rst and sensor/models.h: pixels count from the corner of the top-left one;
the coefficients of its radial and OPENCV models are OpenCV's.
"""

from __future__ import annotations

import re
from typing import Any

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import CORNER_TO_CENTRE_PX, Entry, unsupported

# Models → their parameters in COLMAP's order; f is both fx and fy.
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_LINE = re.compile(r"\d+\s+[A-Z][A-Z_0-9]+\s+\d{1,9}\s+\d{1,9}(\s+\S+)+")


def matches(file: ForeignFile) -> bool:
    """Whether the first line that is not a comment describes a camera."""
    rows = file.rows
    return bool(rows) and _LINE.fullmatch(rows[0][1]) is not None


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the cameras, named by their CAMERA_ID."""
    return tuple(_entry(file, line, row) for line, row in file.rows)


def _entry(file: ForeignFile, line: int, row: str) -> Entry:
    if _LINE.fullmatch(row) is None:
        raise file.error_at(
            f"line {line}", "is not CAMERA_ID MODEL WIDTH HEIGHT PARAMS", "repair the line"
        )
    name, model, width, height, *params = row.split()

    def convert(width: int, height: int) -> Camera:
        """Return the camera for frames of this size."""
        if model not in _MODELS:
            raise unsupported(file, f"the model {model}", f"line {line}")
        keys = _MODELS[model]
        numbers = file.numbers(" ".join(params), len(keys), f"line {line}")
        values: dict[str, Any] = dict(zip(keys, numbers, strict=True))
        if "f" in values:
            values["fx"] = values["fy"] = values.pop("f")
        values["cx"] += CORNER_TO_CENTRE_PX
        values["cy"] += CORNER_TO_CENTRE_PX
        return Camera(width, height, **values)

    return Entry(name, (int(width), int(height)), convert)
