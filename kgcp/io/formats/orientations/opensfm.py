"""OpenSfM's and OpenDroneMap's reconstruction.json.

By OpenSfM's io.py and geometry.rst: a list of reconstructions, whose shots have a rotation (axis
times angle) and a translation from the world to the camera (x right, y down, z forward); its
centre is −Rᵀ t. The world is east, north, up over `reference_lla` (WGS 84), which stands in the
file or in reference_lla.json beside it.

OpenDroneMap overwrites the file with UTM coordinates less an offset, and keeps the original as
reconstruction.topocentric.json.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.georef.crs import WGS84_3D
from kgcp.georef.local_frame import MapFrame
from kgcp.io.files.sniff import ForeignFile, JsonObject
from kgcp.io.formats.orientations.source import SourcePoses, photo_rotation

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
    """Return the poses of all reconstructions.

    Raises
    ------
    KgcpError
        Naming the shot: no rotation or translation of three numbers; or reconstructions that do
        not share their reference.
    """
    document = file.document if isinstance(file.document, list) else [file.document]
    parts = [JsonObject.of(file, f"[{index}]", part) for index, part in enumerate(document)]
    groups = [part.child("shots") for part in parts]
    shots = [group.child(name) for group in groups for name in group.values]
    rotvec = np.array([shot.vector("rotation", 3) for shot in shots]).reshape(-1, 3)
    shift = np.array([shot.vector("translation", 3) for shot in shots]).reshape(-1, 3)
    world_from_camera = np.swapaxes(Rotation.from_rotvec(rotvec).as_matrix(), 1, 2)
    turned = [
        photo_rotation(file, shot.where, matrix)
        for shot, matrix in zip(shots, world_from_camera, strict=True)
    ]
    level = _level(file, parts)
    return SourcePoses(
        tuple(name for group in groups for name in group.values),
        -np.einsum("nij,nj->ni", world_from_camera, shift),
        np.array(turned).reshape(-1, 3, 3),
        level=level,
        unreferenced=_unreferenced(file, level),
    )


def _unreferenced(file: ForeignFile, level: MapFrame | None) -> str | None:
    if file.path.name != _TOPOCENTRIC and (file.path.parent / _TOPOCENTRIC).is_file():
        return f"may hold OpenDroneMap's UTM coordinates: {_TOPOCENTRIC} beside it does not"
    return f"has no reference_lla, nor has {_REFERENCE} beside it" if level is None else None


def _level(file: ForeignFile, parts: Sequence[JsonObject]) -> MapFrame | None:
    """Return the frame over the reference; None where there is none."""
    references = [part.child("reference_lla") for part in parts if part.values.get("reference_lla")]
    beside = file.path.parent / _REFERENCE
    if not references and beside.is_file():
        other = ForeignFile.read(beside, "[reference] poses")
        references = [JsonObject.of(other, "", other.document)]
    origins = {_lla(reference) for reference in references}
    if len(origins) > 1:
        raise file.error(
            "", "holds reconstructions of different reference_lla", "keep those of one of them"
        )
    return MapFrame.at(WGS84_3D, np.array(origins.pop())) if origins else None


def _lla(reference: JsonObject) -> tuple[float, float, float]:
    """Return longitude, latitude, height: x first."""
    keys = ("longitude", "latitude", "altitude")
    longitude, latitude, altitude = (reference.number(key) for key in keys)
    return longitude, latitude, altitude
