"""The Open Photogrammetry Format: calibrated_cameras.json, or the project that names it.

By opf-spec: positions are in the canonical frame. The scene reference frame derives it from its
base CRS: axes are scaled to be isometric, x and y are swapped if the CRS has northing first, and
the origin is shifted. orientation_deg is ω, φ, κ of docs/conventions.md relative to that frame's
axes. Image names are in the camera list. A constant geoid_height leads from heights to ellipsoidal
ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import rotation_from_opk
from kgcp.georef.crs import crs_of
from kgcp.io.files.safe_read import is_file
from kgcp.io.files.sniff import ForeignFile, NamedValues, vectors
from kgcp.io.formats.orientations.records import SourcePoses

_CAMERAS = "calibrated-cameras"
_SCENE = "scene-reference-frame"
_LIST = "camera-list"
_PROJECT = "project"
_KEY = "[reference] poses"


def matches(file: ForeignFile) -> bool:
    """Whether the content says that it is one of the two."""
    return _kind(file) in (_CAMERAS, _PROJECT)


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in the base CRS of the scene."""
    calibrated = NamedValues.of(*_part(file, _CAMERAS))
    cameras = calibrated.children("cameras")
    names = _names(NamedValues.of(*_part(file, _LIST)))
    for camera in cameras:
        if camera.text("id") not in names:
            raise camera.error("has an id that the camera list lacks", "export the project again")
    scene = _Scene.of(NamedValues.of(*_part(file, _SCENE)))
    return SourcePoses(
        tuple(names[camera.text("id")] for camera in cameras),
        scene.map_from_canonical(vectors(cameras, "position")),
        rotation_from_opk(vectors(cameras, "orientation_deg")),
        crs=scene.crs,
        unreferenced="is in a scene without a map",
    )


def _kind(file: ForeignFile) -> str:
    """Return the kind that an OPF file states; empty for other files."""
    stated = file.document.get("format") if isinstance(file.document, dict) else None
    word = stated if isinstance(stated, str) else ""
    return word.removeprefix("application/opf-").removesuffix("+json")


def _part(file: ForeignFile, kind: str) -> tuple[ForeignFile, str, object]:
    """Return the file of one kind: this one, one that the project names, or one beside it."""
    if _kind(file) == kind:
        return file, "", file.document
    path = file.path.parent / f"{kind.replace('-', '_')}.json"
    if _kind(file) == _PROJECT:
        path = _resource(file, kind)
    if not is_file(path):
        raise file.error(
            f"needs {path}, which does not exist", f"name the project, an .opf, in {_KEY}"
        )
    part = ForeignFile(path, _KEY)
    if _kind(part) != kind:
        raise part.error(f"is not a {kind} of OPF", "export the project again")
    return part, "", part.document


def _resource(project: ForeignFile, kind: str) -> Path:
    for item in NamedValues.of(project, "", project.document).children("items"):
        for resource in item.children("resources"):
            if resource.text("format") == f"application/opf-{kind}+json":
                return project.path.parent / unquote(urlsplit(resource.text("uri")).path)
    raise project.error(f"names no {kind}", "export the calibrated project again")


def _names(cameras: NamedValues) -> dict[str, str]:
    """Return image names by camera id; URIs without their scheme and page."""
    return {
        camera.text("id"): unquote(urlsplit(camera.text("uri")).path)
        for camera in cameras.children("cameras")
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """The transformation from the canonical frame to the map; crs None: that is not a map.

    Heights z of the base become (z + geoid_height) · height_factor. They are then ellipsoidal and
    in metres if the CRS does not define its own, or if OPF gives it a constant geoid.
    """

    crs: str | None
    shift: FloatArray
    scale: FloatArray
    height_factor: float
    geoid_height: float

    @classmethod
    def of(cls, scene: NamedValues) -> _Scene:
        """Read a scene reference frame.

        Raises
        ------
        KgcpError
            If something is missing, a scale is not positive, or the CRS is not projected or has
            axes that OPF's swapping does not bring into the order x, y.
        """
        transform, stated = scene.child("base_to_canonical"), scene.child("crs")
        shift = np.array(transform.vector("shift", 3))
        scale = np.array(transform.vector("scale", 3))
        if not np.all(scale > 0.0):
            raise transform.error("has no positive scale")
        swaps = transform["swap_xy"] is True
        if swaps:
            scale = scale[[1, 0, 2]]
        crs = _parsed(stated)
        if crs is None:
            return cls(None, shift, scale, 1.0, 0.0)
        _check_axes(stated, crs, swaps=swaps)
        if len(crs.axis_info) > 2 and "geoid_height" not in stated:
            return cls(crs.to_wkt(), shift, scale, 1.0, 0.0)
        factor = crs.axis_info[-1].unit_conversion_factor
        if len(crs.axis_info) == 2:  # scaled heights and scaled eastings have the same unit
            factor *= float(scale[2] / scale[0])
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
        return cls(horizontal.to_wkt(), shift, scale, factor, stated.number("geoid_height", 0.0))

    def map_from_canonical(self, position: FloatArray) -> FloatArray:
        """Transform positions (n, 3) to the map, x first."""
        base = (position - self.shift) / self.scale
        base[:, 2] = (base[:, 2] + self.geoid_height) * self.height_factor
        return base


def _parsed(stated: NamedValues) -> CRS | None:
    """Return the CRS; None if it is not on the Earth."""
    text = stated.text("definition")
    try:
        crs = crs_of(text)
    except CRSError as error:
        raise stated.error(f"is not a CRS that pyproj reads ({text[:40]!r})") from error
    if crs.geodetic_crs is None:
        return None
    if not crs.is_projected:
        raise stated.error(f"{crs.name!r} is not projected")
    return crs


def _check_axes(stated: NamedValues, crs: CRS, *, swaps: bool) -> None:
    """Refuse axes that swapping would not bring into the order x, y."""
    directions = [axis.direction for axis in crs.axis_info[:2]]
    swapped = {"north east": True, "east north": False, "west south": False}
    if swapped.get(" ".join(directions)) is not swaps:
        raise stated.error(
            f"has the axes {' and '.join(directions)} with swap_xy {str(swaps).lower()}",
            "export the project in a CRS of easting and northing",
        )
