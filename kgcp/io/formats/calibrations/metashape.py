"""Agisoft Metashape's calibration XML, and the sensors of its cameras XML.

By the manual's frame camera model, with r² = x² + y²:

    x' = x (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P1 (r² + 2 x²) + 2 P2 x y
    y' = y (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P2 (r² + 2 y²) + 2 P1 x y
    u = w/2 + cx + x' f + x' B1 + y' B2        v = h/2 + cy + y' f

u and v count from the corner of the top-left pixel. So p1 = P2, p2 = P1, fx = f + B1, fy = f. Old
versions multiplied the tangential terms by 1 + P3 r² + P4 r⁴.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import CORNER_TO_CENTRE_PX, Entry, refuse_terms, unsupported

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_FOREIGN_TERMS = ("b2", "k4", "p3", "p4")


def matches(file: ForeignFile) -> bool:
    """Whether the content is a calibration, or a document with sensors."""
    root = file.root
    if root is None:
        return False
    return root.tag == "calibration" or (
        root.tag == "document" and root.find(".//sensors/sensor") is not None
    )


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the cameras. Those of a cameras XML are adjusted ones, named by label or else id."""
    if file.root is None:
        raise file.error("is not XML", "export it from Metashape again")
    if file.root.tag == "calibration":
        return (_entry(file, "", file.root),)
    cameras: list[Entry] = []
    sensors = file.root.findall(".//sensors/sensor")
    labels = [sensor.get("label") for sensor in sensors]
    is_labelled = all(labels) and len(set(labels)) == len(labels)
    for sensor in sensors:
        name = sensor.get("label" if is_labelled else "id") or ""
        calibrations = sensor.findall("calibration")
        adjusted = [element for element in calibrations if element.get("class") == "adjusted"]
        cameras += [_entry(file, name, element) for element in (adjusted or calibrations)[:1]]
    return tuple(cameras)


def _entry(file: ForeignFile, name: str, element: Element) -> Entry:
    where = f"sensor {name!r}" if name else "calibration"
    resolution = element.find("resolution")
    if resolution is None:
        width, height = element.findtext("width"), element.findtext("height")
    else:
        width, height = resolution.get("width"), resolution.get("height")
    size = file.numbers(f"{width or ''} {height or ''}", 2, f"{where} size")

    def convert(width: int, height: int) -> Camera:
        return _camera(file, where, element, width, height)

    return Entry(name, (int(size[0]), int(size[1])), convert)


def _camera(file: ForeignFile, where: str, element: Element, width: int, height: int) -> Camera:
    projection = element.findtext("projection") or element.get("type") or "frame"
    if projection != "frame":
        raise unsupported(file, f"the projection {projection!r}", where)

    def number(key: str) -> float:
        text = element.findtext(key)
        return 0.0 if text is None else file.numbers(text, 1, f"{where} {key}")[0]

    if element.find("f") is None:
        raise file.error_at(
            where, "has no <f>, as in files of old PhotoScan", "export it from Metashape again"
        )
    refuse_terms(
        file, where, [term.upper() for term in _FOREIGN_TERMS], [*map(number, _FOREIGN_TERMS)]
    )
    return Camera(
        width,
        height,
        fx=number("f") + number("b1"),
        fy=number("f"),
        cx=0.5 * width + number("cx") + CORNER_TO_CENTRE_PX,
        cy=0.5 * height + number("cy") + CORNER_TO_CENTRE_PX,
        k1=number("k1"),
        k2=number("k2"),
        k3=number("k3"),
        p1=number("p2"),
        p2=number("p1"),
    )
