"""OpenSfM's and OpenDroneMap's reconstruction.json.

By OpenSfM's io.py and geometry.rst: a list of reconstructions, whose shots have a rotation (axis
times angle) and a translation from the world to the camera (x right, y down, z forward); its
centre is −Rᵀ t. The world is east, north, up over `reference_lla` (WGS 84), which is in the
file or in reference_lla.json beside it.

OpenDroneMap overwrites the file with UTM coordinates less an offset, and keeps the original as
reconstruction.topocentric.json.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.georef.crs import WGS84_3D
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.files.sniff import ForeignFile, NamedValues, vectors
from kgcp.io.formats.orientations.records import SourcePoses, photo_rotations

_TOPOCENTRIC = "reconstruction.topocentric.json"
_REFERENCE = "reference_lla.json"


def matches(file: ForeignFile) -> bool:
    """Whether the content is a list of reconstructions."""
    parts = file.document
    return (
        isinstance(parts, list)
        and bool(parts)
        and all(isinstance(part, dict) and "shots" in part for part in parts)
    )


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses of all reconstructions."""
    document = file.document if isinstance(file.document, list) else [file.document]
    parts = [NamedValues.of(file, f"[{index}]", part) for index, part in enumerate(document)]
    groups = [part.child("shots") for part in parts]
    shots = [group.child(name) for group in groups for name in group.values]
    rotation = Rotation.from_rotvec(vectors(shots, "rotation")).as_matrix()
    world_from_camera = np.swapaxes(rotation, 1, 2)
    level = _level(file, parts)
    return SourcePoses(
        tuple(name for group in groups for name in group.values),
        -np.einsum("nij,nj->ni", world_from_camera, vectors(shots, "translation")),
        photo_rotations(file, [shot.where for shot in shots], world_from_camera),
        level=level,
        unreferenced=_unreferenced(file, level),
    )


def _unreferenced(file: ForeignFile, level: LocalFrame | None) -> str | None:
    if file.path.name != _TOPOCENTRIC and (file.path.parent / _TOPOCENTRIC).is_file():
        return f"may hold OpenDroneMap's UTM coordinates: {_TOPOCENTRIC} beside it does not"
    return f"has no reference_lla, nor has {_REFERENCE} beside it" if level is None else None


def _level(file: ForeignFile, parts: Sequence[NamedValues]) -> LocalFrame | None:
    """Return the ENU frame at the reference; None without a reference."""
    references = [part.child("reference_lla") for part in parts if part.values.get("reference_lla")]
    beside = file.path.parent / _REFERENCE
    if not references and beside.is_file():
        reference_file = ForeignFile(beside, "[reference] poses")
        references = [NamedValues.of(reference_file, "", reference_file.document)]
    origins = {_lla(reference) for reference in references}
    if len(origins) > 1:
        raise file.error(
            "holds reconstructions of different reference_lla", "keep those of one of them"
        )
    return LocalFrame.at(WGS84_3D, np.array(origins.pop())) if origins else None


def _lla(reference: NamedValues) -> tuple[float, float, float]:
    """Return longitude, latitude, height: x first."""
    keys = ("longitude", "latitude", "altitude")
    longitude, latitude, altitude = (reference.number(key) for key in keys)
    return longitude, latitude, altitude
