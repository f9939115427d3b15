"""The part of Metashape's Python API 2 that the script uses, as its reference documents it.

Every class has the attributes of the reference and no others, and every value the type that it
names there: a wrong attribute, argument or unit of grouping is an error, as in the program.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from inspect import getattr_static
from pathlib import Path
from types import ModuleType
from typing import Any

from pyproj import CRS, Transformer


class Attribute:
    """An attribute of one of the documented types; None is allowed where it may be unset."""

    def __init__(self, *types: type | None) -> None:
        self.types = tuple(kind for kind in types if kind is not None)
        self.is_optional = None in types

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = f"_{name}"

    def __get__(self, instance: object, owner: type) -> Any:  # noqa: ANN401 - of any of the types
        return getattr(instance, self.name, None)

    def __set__(self, instance: object, value: object) -> None:
        is_unset = value is None and self.is_optional
        is_right = isinstance(value, self.types) and not (
            isinstance(value, bool) and bool not in self.types
        )
        if not is_unset and not is_right:
            raise TypeError(f"{type(instance).__name__}.{self.name[1:]}: {value!r}")
        object.__setattr__(instance, self.name, value)


class Documented:
    """An object that has no attributes but the documented ones."""

    def __setattr__(self, name: str, value: object) -> None:
        if not isinstance(getattr_static(type(self), name, None), Attribute):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        super().__setattr__(name, value)


class Vector:
    def __init__(self, values: Iterable[float]) -> None:
        self._values = [float(value) for value in values]

    def __iter__(self) -> Iterator[float]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


class CoordinateSystem:
    def __init__(self, text: str) -> None:
        self._crs = CRS.from_user_input(text.replace("::", ":"))

    @property
    def wkt(self) -> str:
        return self._crs.to_wkt()

    @staticmethod
    def transform(point: Vector, source: CoordinateSystem, target: CoordinateSystem) -> Vector:
        return Vector(_transformer(source.wkt, target.wkt).transform(*point))


@lru_cache(maxsize=8)
def _transformer(source: str, target: str) -> Transformer:
    first, second = (CRS.from_user_input(text).to_3d() for text in (source, target))
    return Transformer.from_crs(first, second, always_xy=True)


class Projection(Documented):
    coord, pinned = Attribute(Vector), Attribute(bool)

    def __init__(self, coord: Vector, pinned: bool) -> None:  # noqa: FBT001 - Metashape's
        self.coord, self.pinned = coord, pinned


class Projections:
    def __init__(self) -> None:
        self._projections: dict[int, tuple[Camera, Projection]] = {}

    def __setitem__(self, camera: object, projection: object) -> None:
        if isinstance(camera, Camera) and projection is None:
            self._projections.pop(camera.key, None)
            return
        if not isinstance(camera, Camera) or not isinstance(projection, Projection):
            raise TypeError(f"{camera!r}: {projection!r}")
        if len(projection.coord) != 2:
            raise ValueError("a projection has two coordinates")
        self._projections[camera.key] = (camera, projection)

    def keys(self) -> list[Camera]:
        return [camera for camera, _ in self._projections.values()]

    def items(self) -> list[tuple[Camera, Projection]]:
        return [*self._projections.values()]


class MarkerReference(Documented):
    accuracy, location = Attribute(Vector, None), Attribute(Vector, None)
    enabled = Attribute(bool)


class Marker(Documented):
    label = Attribute(str)
    Projection = Projection

    def __init__(self) -> None:
        self.label = "point 1"
        object.__setattr__(self, "projections", Projections())
        object.__setattr__(self, "reference", MarkerReference())

    projections: Projections
    reference: MarkerReference


class CameraReference(Documented):
    accuracy, location = Attribute(Vector, None), Attribute(Vector, None)
    location_accuracy, rotation = Attribute(Vector, None), Attribute(Vector, None)
    rotation_accuracy = Attribute(Vector, None)
    enabled, location_enabled, rotation_enabled = Attribute(bool), Attribute(bool), Attribute(bool)


class Photo(Documented):
    path = Attribute(str)

    def __init__(self, path: str) -> None:
        self.path = path


class Camera(Documented):
    key, label, photo = Attribute(int), Attribute(str), Attribute(Photo, None)

    def __init__(self, key: int, label: str, path: str | None = None) -> None:
        self.key, self.label = key, label
        self.photo = None if path is None else Photo(path)
        object.__setattr__(self, "reference", CameraReference())

    reference: CameraReference


class ScalebarReference(Documented):
    distance, accuracy, enabled = Attribute(float), Attribute(float), Attribute(bool)


class Scalebar(Documented):
    label = Attribute(str)

    def __init__(self, point0: Marker | Camera, point1: Marker | Camera) -> None:
        self.label = "scalebar"
        object.__setattr__(self, "point0", point0)
        object.__setattr__(self, "point1", point1)
        object.__setattr__(self, "reference", ScalebarReference())

    point0: Marker | Camera
    point1: Marker | Camera
    reference: ScalebarReference


class EulerAngles:
    def __init__(self, name: str) -> None:
        self.name = name


class Chunk(Documented):
    crs, marker_crs = Attribute(CoordinateSystem, None), Attribute(CoordinateSystem, None)
    camera_crs = Attribute(CoordinateSystem, None)
    euler_angles = Attribute(EulerAngles)
    marker_projection_accuracy = Attribute(float)

    def __init__(self, cameras: list[Camera]) -> None:
        for name, value in (("cameras", cameras), ("markers", []), ("scalebars", [])):
            object.__setattr__(self, name, value)
        self.crs = CoordinateSystem("EPSG::4326")
        self.euler_angles = YPR
        self.marker_projection_accuracy = 0.5

    cameras: list[Camera]
    markers: list[Marker]
    scalebars: list[Scalebar]

    def addMarker(self, point: Vector | None = None, visibility: bool = False) -> Marker:  # noqa: FBT001, FBT002, N802 - Metashape's
        assert point is None
        assert not visibility
        self.markers.append(Marker())
        return self.markers[-1]

    def addScalebar(self, point1: object, point2: object) -> Scalebar:  # noqa: N802 - Metashape's
        if not isinstance(point1, (Marker, Camera)) or not isinstance(point2, (Marker, Camera)):
            raise TypeError(f"{point1!r}, {point2!r}")
        self.scalebars.append(Scalebar(point1, point2))
        return self.scalebars[-1]

    def remove(self, items: list[Marker | Scalebar]) -> None:
        for item in items:
            group: list[Any] = self.markers if isinstance(item, Marker) else self.scalebars
            group.remove(item)


class Document(Documented):
    chunk = Attribute(Chunk, None)


class Application(Documented):
    document = Attribute(Document)


YPR, OPK = EulerAngles("EulerAnglesYPR"), EulerAngles("EulerAnglesOPK")


def run_script(text: str, path: Path, chunk: Chunk | None) -> None:
    """Run a script as Tools > Run Script does, with a chunk as the active one."""
    module = ModuleType("Metashape")
    document, application = Document(), Application()
    document.chunk = chunk
    application.document = document
    documented = {
        "app": application,
        "Camera": Camera,
        "CoordinateSystem": CoordinateSystem,
        "EulerAnglesOPK": OPK,
        "EulerAnglesYPR": YPR,
        "Marker": Marker,
        "Vector": Vector,
    }
    for name, value in documented.items():
        setattr(module, name, value)
    without_import = text.replace("\nimport Metashape\n", "\n")
    assert without_import != text
    names = {"__name__": "__main__", "__file__": str(path), "Metashape": module}
    exec(compile(without_import, str(path), "exec"), names)  # noqa: S102 - it is the project's own
