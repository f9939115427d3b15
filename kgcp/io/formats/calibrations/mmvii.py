"""MicMac's MMVII: the internal calibration of a perspective camera, in XML.

With normalised coordinates X, Y and r² = X² + Y², the file itself states the displacements:

    K1 (X, Y) r² + K2 (X, Y) r⁴ + K3 (X, Y) r⁶
    p1 (3 X² + Y², 2 X Y) + p2 (2 X Y, X² + 3 Y²) + b1 (X, 0) + b2 (Y, 0)

The sum, times F and moved by PP, is the pixel, which counts from the centre of the top-left one.
So p1 = p2 of MMVII and p2 = p1 of MMVII. b1 is no second focal length: it acts on coordinates
before distortion, and fx / fy after it.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry, refuse_terms, unsupported

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_TERMS = ("K1", "K2", "K3", "p1", "p2")


def matches(file: ForeignFile) -> bool:
    """Whether the content is an internal calibration of MMVII."""
    return file.root is not None and file.root.find(".//InternalCalibration") is not None


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the cameras, by their names."""
    if file.root is None:
        raise file.error("is not XML", "export it from MMVII again")
    cameras = []
    for element in file.root.iter("InternalCalibration"):
        name = _text(element, "Name")
        width, height = file.numbers(element.findtext("PixelFrame/NbPix"), 2, f"{name} NbPix")
        convert = partial(_camera, file, name, element)
        cameras.append(Entry(name, (int(width), int(height)), convert))
    return tuple(cameras)


def _camera(file: ForeignFile, name: str, element: Element, width: int, height: int) -> Camera:
    projection = _text(element, "Projection")
    if projection != "Stenope":
        raise unsupported(file, f"the projection {projection[:40]!r}", name)
    (focal,) = file.numbers(element.findtext("PerfectProj/F"), 1, f"{name} F")
    cx, cy = file.numbers(element.findtext("PerfectProj/PP"), 2, f"{name} PP")
    terms = dict.fromkeys(_TERMS, 0.0)
    for group in element.findall("Distorsion/*"):
        for term in group:
            (terms[term.tag],) = file.numbers(term.text, 1, f"{name} {term.tag}")
    foreign_terms = [tag for tag in terms if tag not in _TERMS]
    refuse_terms(file, name, foreign_terms, [terms[tag] for tag in foreign_terms])
    return Camera(
        width,
        height,
        fx=focal,
        fy=focal,
        cx=cx,
        cy=cy,
        k1=terms["K1"],
        k2=terms["K2"],
        k3=terms["K3"],
        p1=terms["p2"],
        p2=terms["p1"],
    )


def _text(element: Element, tag: str) -> str:
    """Return a text, which MMVII puts between quotes."""
    return (element.findtext(tag) or "").strip().strip('"')
