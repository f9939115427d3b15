"""Agisoft Metashape's cameras XML.

By its exports and scripts: a camera's <transform> (4 × 4, row by row) leads from the camera (x
right, y down, z forward) to the chunk, and the <transform> of its component or of the chunk, with
rotation, translation and scale, from there to the world: geocentric where the chunk's <reference>
is a CRS of the Earth, else its local coordinates. In the former case heights are ellipsoidal,
whatever the CRS says of them. Cameras without a transform are not aligned and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pyproj.exceptions import CRSError

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import CAMERA_FROM_PHOTO
from kgcp.georef.crs import crs_of
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import (
    SourcePoses,
    from_geocentric,
    require_rotation,
)

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


def matches(file: ForeignFile) -> bool:
    """Whether the content is a document with cameras."""
    return (
        file.root is not None
        and file.root.tag == "document"
        and file.root.find("chunk/cameras") is not None
    )


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses of the aligned cameras."""
    chunks = [] if file.root is None else file.root.findall("chunk")
    if len(chunks) != 1:
        raise file.error(f"holds {len(chunks)} chunks instead of one", "export one chunk")
    chunk = chunks[0]
    chunk_to_world = _similarity(file, chunk)
    to_world = {
        component.get("id", ""): _similarity(file, component) or chunk_to_world
        for component in chunk.iterfind("components/component")
    }
    names, centres, rotations = [], [], []
    is_in_world = True
    for camera in chunk.iterfind("cameras//camera"):
        text = camera.findtext("transform")
        if text is None:
            continue
        where = f"camera {camera.get('label')!r}"
        matrix = np.array(file.numbers(text, 16, f"{where} transform")).reshape(4, 4)
        require_rotation(file, where, matrix[:3, :3])
        centre, rotation = matrix[:3, 3], matrix[:3, :3] @ CAMERA_FROM_PHOTO
        similarity = to_world.get(camera.get("component_id", ""), chunk_to_world)
        if similarity is None:
            is_in_world = False
        else:
            centre = similarity.scale * similarity.rotation @ centre + similarity.translation
            rotation = similarity.rotation @ rotation
        names.append(camera.get("label") or "")
        centres.append(centre)
        rotations.append(rotation)
    position = np.array(centres).reshape(-1, 3)
    frame_from_photo = np.array(rotations).reshape(-1, 3, 3)
    geodetic = _geodetic(file, chunk)
    if is_in_world and geodetic is not None:
        return from_geocentric(tuple(names), position, frame_from_photo, geodetic)
    problem = (
        "is in local coordinates"
        if geodetic is None
        else "has cameras without a transform to the world"
    )
    return SourcePoses(tuple(names), position, frame_from_photo, unreferenced=problem)


@dataclass(frozen=True, slots=True, eq=False)
class _Similarity:
    """x ↦ scale R x + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray


def _similarity(file: ForeignFile, parent: Element) -> _Similarity | None:
    element = parent.find("transform")
    if element is None or element.find("translation") is None:
        return None
    where = f"{parent.tag} {parent.get('label') or parent.get('id') or ''} transform".strip()
    rotation = file.numbers(element.findtext("rotation"), 9, f"{where} rotation")
    translation = file.numbers(element.findtext("translation"), 3, f"{where} translation")
    (scale,) = file.numbers(element.findtext("scale") or "1", 1, f"{where} scale")
    if scale <= 0.0:
        raise file.error_at(where, f"has the scale {scale:g}")
    matrix = np.array(rotation).reshape(3, 3)
    require_rotation(file, where, matrix)
    return _Similarity(scale, matrix, np.array(translation))


def _geodetic(file: ForeignFile, chunk: Element) -> str | None:
    """Return the geographic CRS of the chunk's datum; None for local coordinates."""
    text = (chunk.findtext("reference") or "").strip()
    if not text:
        return None
    try:
        crs = crs_of(text)
    except CRSError as error:
        raise file.error_at(
            "chunk reference",
            f"is not a CRS that pyproj reads ({text[:40]!r})",
            "export it in another",
        ) from error
    geodetic = crs.geodetic_crs
    return None if geodetic is None else geodetic.to_3d().to_string()
