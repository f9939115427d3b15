"""COLMAP's images.txt.

By COLMAP's doc/format.rst: two lines per image, `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` and
its points, which may be an empty line. The quaternion (Hamilton, w first) and the translation lead
from the world to the camera (x right, y down, z forward), whose centre is −Rᵀ t; of rigs, too,
each image has its own. The world is nobody's map; after aligning it, flight.toml may say of which
one it is.
"""

from __future__ import annotations

import math
import re

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.source import SourcePoses, photo_rotation

_SHORTEST = 1e-6  # of quaternions, which should have the length 1
_LINE = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+(\S.*)")


def matches(file: ForeignFile) -> bool:
    """Whether the first line that is no comment describes an image."""
    rows = file.rows
    return bool(rows) and _LINE.fullmatch(rows[0][1]) is not None


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in COLMAP's world.

    Raises
    ------
    KgcpError
        Naming the line that describes no image.
    """
    names, positions, rotations = [], [], []
    for line, row in _image_rows(file):
        name, centre, rotation = _pose(file, f"line {line}", row)
        names.append(name)
        positions.append(centre)
        rotations.append(rotation)
    return SourcePoses(
        tuple(names),
        np.array(positions).reshape(-1, 3),
        np.array(rotations).reshape(-1, 3, 3),
        unreferenced="is in a world of COLMAP's, which is no map",
    )


def _image_rows(file: ForeignFile) -> list[tuple[int, str]]:
    """Return every other line; those of the points count even where they are empty."""
    lines = list(enumerate(file.text.splitlines(), start=1))
    rows = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    return [(number, line.strip()) for number, line in rows[::2] if line.strip()]


def _pose(file: ForeignFile, where: str, row: str) -> tuple[str, FloatArray, FloatArray]:
    """Return name, centre (3,) and rotation (3, 3) world ← photo."""
    if _LINE.fullmatch(row) is None:
        raise file.error(
            where,
            "is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
            "keep two lines per image, the second of which may be empty",
        )
    *numbers, _, name = row.split(maxsplit=9)
    _, w, x, y, z, *translation = file.numbers(" ".join(numbers), 8, where)
    if math.hypot(w, x, y, z) < _SHORTEST:
        raise file.error(where, "has a quaternion of zeros", "export it again")
    world_from_camera = np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix()).T
    rotation = photo_rotation(file, where, world_from_camera)
    return name.strip(), -world_from_camera @ np.array(translation), rotation
