"""What the header of an image says, before anything of it is decoded or even read."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from PIL import Image

FORMATS = ("BMP", "JPEG", "JPEG2000", "PNG", "PPM", "WEBP")
"""Pillow's names of what a frame may be, beside TIFF, whatever its name ends in."""

_WIDTH, _HEIGHT, _ORIENTATION = 256, 257, 274
_UPRIGHT = 1
_SHORT = 3
_MOST_TAGS = 0xFFFF  # more, libtiff does not read either
_INTEGERS = {1: "B", _SHORT: "H", 4: "I", 16: "Q"}  # BYTE, SHORT, LONG, LONG8


@dataclass(frozen=True, slots=True)
class _Layout:
    """How TIFF, or BigTIFF, counts and places things."""

    order: str
    first: str
    count: str
    entry: str
    field: int

    @classmethod
    def of(cls, head: bytes) -> _Layout | None:
        """Return that of a file that begins with `head`; None where it is no TIFF."""
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 16:
            return None
        (version,) = struct.unpack_from(f"{order}H", head, 2)
        if version == 42:
            return cls(order, "4xI", "H", "HHI", 4)
        return cls(order, "8xQ", "Q", "HHQ", 8) if version == 43 else None


@dataclass(frozen=True, slots=True)
class _Entry:
    """A tag of the first image of a TIFF, and where in the file it stands."""

    place: int
    tag: int
    kind: int
    value: bytes


def image_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Return width and height [px] of the first image in a file.

    None, if it is of no format that a frame may have, or its header is damaged.
    """
    layout = _Layout.of(stream.read(16))
    if layout is not None:
        return _tiff_size(stream, layout)
    stream.seek(0)
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # nothing is decoded here
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(stream, "r", FORMATS) as image:
            return image.size
    except Exception:  # Pillow's parsers raise whatever a damaged header makes them stumble over
        return None
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def upright(stream: BinaryIO) -> bytes:
    """Return a file with a TIFF's orientation tags saying that there is nothing to turn.

    OpenCV turns a TIFF by that tag even if it is told not to.
    """
    stream.seek(0)
    layout = _Layout.of(stream.read(16))
    places = []
    if layout is not None:
        places = [one.place for one in _entries(stream, layout) if one.tag == _ORIENTATION]
    stream.seek(0)
    data = stream.read()
    if layout is None or not places:
        return data
    turned = bytearray(data)
    for place in places:
        code = f"{layout.order}{layout.entry}H{layout.field - 2}x"
        struct.pack_into(code, turned, place, _ORIENTATION, _SHORT, 1, _UPRIGHT)
    return bytes(turned)


def _tiff_size(stream: BinaryIO, layout: _Layout) -> tuple[int, int] | None:
    found: dict[int, int] = {}
    for entry in _entries(stream, layout):
        code = _INTEGERS.get(entry.kind)
        if entry.tag in (_WIDTH, _HEIGHT) and code is not None:
            (value,) = struct.unpack_from(layout.order + code, entry.value.ljust(8, b"\0"))
            found.setdefault(entry.tag, value)
    return (found[_WIDTH], found[_HEIGHT]) if len(found) == 2 else None


def _entries(stream: BinaryIO, layout: _Layout) -> Iterator[_Entry]:
    """Yield the tags of the first image, as far as the file has them."""
    stream.seek(0)
    try:
        (first,) = struct.unpack(layout.order + layout.first, stream.read(2 * layout.field))
        place = first + struct.calcsize(layout.order + layout.count)
        stream.seek(first)
        (count,) = struct.unpack(layout.order + layout.count, stream.read(place - first))
        size = struct.calcsize(layout.order + layout.entry)
        for _ in range(min(count, _MOST_TAGS)):
            entry = stream.read(size + layout.field)
            if len(entry) < size + layout.field:
                return
            tag, kind, _ = struct.unpack_from(layout.order + layout.entry, entry)
            yield _Entry(place, tag, kind, entry[size:])
            place += len(entry)
    except (struct.error, OverflowError, ValueError, OSError):
        return  # the file is cut, or no place is where it says
