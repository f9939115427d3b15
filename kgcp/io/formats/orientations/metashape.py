"""Agisoft Metashape's cameras XML.

By its exports and scripts: a camera's <transform> (4 × 4, row by row) leads from the camera (x
right, y down, z forward) to the chunk, and the <transform> of its component or of the chunk, with
rotation, translation and scale, from there to the world: geocentric where the chunk's <reference>
is a CRS of the Earth (heights are then ellipsoidal, whatever it says of them), else its local
coordinates. Cameras without a transform are not aligned, and left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pyproj.exceptions import CRSError

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import crs_of
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.source import (
    SourcePoses,
    from_geocentric,
    photo_rotation,
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
    """Return the poses of the aligned cameras.

    Raises
    ------
    KgcpError
        If the file is no such XML, has several chunks, or numbers are missing.
    """
    chunks = [] if file.root is None else file.root.findall("chunk")
    if len(chunks) != 1:
        raise file.error("", f"holds {len(chunks)} chunks instead of one", "export one chunk")
    worlds = _Worlds.of(file, chunks[0])
    aligned = [
        (camera, matrix)
        for camera in chunks[0].iterfind("cameras//camera")
        if (matrix := camera.findtext("transform")) is not None
    ]
    names = tuple(camera.get("label") or "" for camera, _ in aligned)
    placed = [worlds.place(camera, matrix) for camera, matrix in aligned]
    position = np.array([position for position, _ in placed]).reshape(-1, 3)
    rotation = np.array([rotation for _, rotation in placed]).reshape(-1, 3, 3)
    geodetic = _geodetic(file, chunks[0])
    if all(worlds.is_referenced(camera) for camera, _ in aligned) and geodetic is not None:
        return from_geocentric(names, position, rotation, geodetic)
    why = "is in local coordinates" if geodetic is None else "has cameras in chunks of no reference"
    return SourcePoses(names, position, rotation, unreferenced=why)


@dataclass(frozen=True, slots=True, eq=False)
class _Similarity:
    """x ↦ scale R x + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Worlds:
    """The ways from a chunk to the world, of its components and of itself."""

    file: ForeignFile
    components: dict[str, _Similarity]
    chunk: _Similarity | None

    @classmethod
    def of(cls, file: ForeignFile, chunk: Element) -> _Worlds:
        """Read the transforms of a chunk and of its components.

        Raises
        ------
        KgcpError
            Naming the transform whose numbers are missing.
        """
        components = {}
        for component in chunk.iterfind("components/component"):
            similarity = _similarity(file, component)
            if similarity is not None:
                components[component.get("id", "")] = similarity
        return cls(file, components, _similarity(file, chunk))

    def is_referenced(self, camera: Element) -> bool:
        """Whether a camera has a way to the world."""
        return self._way(camera) is not None

    def place(self, camera: Element, matrix_text: str) -> tuple[FloatArray, FloatArray]:
        """Return centre (3,) and rotation (3, 3) ← photo in the world, or else in the chunk."""
        where = f"camera {camera.get('label')!r}"
        numbers = self.file.numbers(matrix_text, 16, f"{where} transform")
        matrix = np.array(numbers).reshape(4, 4)
        rotation = photo_rotation(self.file, where, matrix[:3, :3])
        way = self._way(camera)
        if way is None:
            return matrix[:3, 3], rotation
        centre = way.scale * way.rotation @ matrix[:3, 3] + way.translation
        return centre, way.rotation @ rotation

    def _way(self, camera: Element) -> _Similarity | None:
        return self.components.get(camera.get("component_id", ""), self.chunk)


def _similarity(file: ForeignFile, parent: Element) -> _Similarity | None:
    element = parent.find("transform")
    if element is None or element.find("translation") is None:
        return None
    where = f"{parent.tag} {parent.get('label') or parent.get('id') or ''} transform".strip()
    rotation = file.numbers(element.findtext("rotation"), 9, f"{where} rotation")
    translation = file.numbers(element.findtext("translation"), 3, f"{where} translation")
    (scale,) = file.numbers(element.findtext("scale") or "1", 1, f"{where} scale")
    if scale <= 0.0:
        raise file.error(where, f"has the scale {scale:g}", "export it again")
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
        raise file.error(
            "chunk reference",
            f"is no CRS that pyproj reads ({text[:40]!r})",
            "export it in another",
        ) from error
    geodetic = crs.geodetic_crs
    return None if geodetic is None else geodetic.to_3d().to_string()
