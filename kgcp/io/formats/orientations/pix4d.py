"""Pix4D's calibrated_external_camera_parameters.txt: imageName X Y Z Omega Phi Kappa.

Its angles are those of docs/conventions.md: R(map ← image) = Rx(ω) Ry(φ) Rz(κ), image axes x right,
y up, z backward, relative to the grid of the output CRS; positions are x, y, z in that CRS.
"""

from __future__ import annotations

import re

import numpy as np

from kgcp.geometry.attitude import rotation_from_opk
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import SourcePoses

_HEAD = re.compile(r"imageName\s+X\s+Y\s+Z\s+Omega\s+Phi\s+Kappa\b")


def matches(file: ForeignFile) -> bool:
    """Whether the first line names its columns."""
    rows = file.rows
    return bool(rows) and _HEAD.match(rows[0][1]) is not None


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in the flight's CRS."""
    rows = [(line, row) for line, row in file.rows if _HEAD.match(row) is None]
    parts = [(line, row.rsplit(maxsplit=6)) for line, row in rows]
    numbers = np.array(
        [file.numbers(" ".join(part[1:]), 6, f"line {line}") for line, part in parts]
    ).reshape(-1, 6)
    return SourcePoses(
        tuple(part[0] for _, part in parts), numbers[:, :3], rotation_from_opk(numbers[:, 3:])
    )
