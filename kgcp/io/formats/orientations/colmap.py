"""COLMAP's images.txt.

By COLMAP's doc/format.rst: two lines per image, `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` and
its points, which may be an empty line. The quaternion (Hamilton, w first) and the translation lead
from the world to the camera (x right, y down, z forward), whose centre is −Rᵀ t. Each image has its
own pose, also in rigs. The world is not a map. If it is aligned to one, flight.toml may name it.
"""

from __future__ import annotations

import math
import re

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import SourcePoses, photo_rotations

_MIN_NORM = 1e-6  # of quaternions, which should be unit ones
_LINE = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+(\S.*)")


def matches(file: ForeignFile) -> bool:
    """Whether the first line that is not a comment describes an image."""
    rows = file.rows
    return bool(rows) and _LINE.fullmatch(rows[0][1]) is not None


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in COLMAP's world."""
    names, centres, rotations, places = [], [], [], []
    for line, row in _image_rows(file):
        where = f"line {line}"
        if _LINE.fullmatch(row) is None:
            raise file.error_at(
                where,
                "is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
                "keep two lines per image, the second of which may be empty",
            )
        *numbers, _, name = row.split(maxsplit=9)
        _, w, x, y, z, *translation = file.numbers(" ".join(numbers), 8, where)
        if math.hypot(w, x, y, z) < _MIN_NORM:
            raise file.error_at(where, "has an invalid quaternion (norm ≈ 0)")
        world_from_camera = np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix()).T
        names.append(name.strip())
        centres.append(-world_from_camera @ np.array(translation))
        rotations.append(world_from_camera)
        places.append(where)
    return SourcePoses(
        tuple(names),
        np.array(centres).reshape(-1, 3),
        photo_rotations(file, places, np.array(rotations).reshape(-1, 3, 3)),
        unreferenced="is in COLMAP's own coordinates, which are not those of a map",
    )


def _image_rows(file: ForeignFile) -> list[tuple[int, str]]:
    """Return every other line; those of points count even if they are empty."""
    lines = list(enumerate(file.text.splitlines(), start=1))
    rows = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    return [(number, line.strip()) for number, line in rows[::2] if line.strip()]
