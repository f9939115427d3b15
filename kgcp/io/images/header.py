"""Size and orientation from the header of an image, before its pixels are decoded or even read.

Pillow gives sizes except those of TIFFs: it refuses pixels that frames may have (16-bit RGB), and
reads every tag on opening. So this module reads the directory of a TIFF itself, by TIFF 6.0,
section 2, and by BigTIFF, which counts with 8 bytes where TIFF has 2 or 4. The directory also has
the orientation, and shows whether tags claim more bytes than the file has.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from PIL import Image

FORMATS = ("BMP", "JPEG", "JPEG2000", "PNG", "PPM", "WEBP")
"""Pillow's names of the formats that frames may have beside TIFF, whatever their suffix."""

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Within pixels, 0xff is followed by 0 or by the number of a restart.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_WIDTH, _HEIGHT, _ORIENTATION, _EXIF = 256, 257, 274, 34665
_UPRIGHT = 1
_SHORT = 3
_MAX_TAGS = 0xFFFF  # as in libtiff
_TYPE_BYTES = {
    3: 2,
    4: 4,
    5: 8,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
}  # of types; others have 1
_INTEGERS = {1: "B", _SHORT: "H", 4: "I", 16: "Q"}  # BYTE, SHORT, LONG, LONG8


@dataclass(frozen=True, slots=True)
class _Layout:
    """Notation of the parts of TIFF or BigTIFF, for `struct`."""

    order: str  # of bytes
    first: str  # head of the file, with the place of the first directory
    count: str  # of entries in a directory
    entry: str  # tag, type and count of an entry
    field: int  # bytes of an entry's value

    @classmethod
    def of(cls, head: bytes) -> _Layout | None:
        """Return the layout of a file that begins with `head`; None if it is not a TIFF."""
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 16:
            return None
        (version,) = struct.unpack_from(f"{order}H", head, 2)
        if version == 42:
            return cls(order, "4xI", "H", "HHI", 4)
        return cls(order, "8xQ", "Q", "HHQ", 8) if version == 43 else None


@dataclass(frozen=True, slots=True)
class _Entry:
    """A tag of a TIFF, and its place in the file."""

    place: int
    tag: int
    kind: int
    count: int
    value: bytes

    def integer(self, order: str) -> int | None:
        """Return the value, if it is one whole number."""
        code = _INTEGERS.get(self.kind)
        if code is None:
            return None
        (value,) = struct.unpack_from(order + code, self.value.ljust(8, b"\0"))
        return int(value)


def image_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Return width and height [px] of the first image in a file.

    None if frames cannot have its format, or its header is damaged.
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
    except Exception:  # damaged headers make Pillow raise any kind of exception
        return None
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def upright(stream: BinaryIO) -> bytes:
    """Return the content of a file; the orientation tags of a TIFF are set to upright.

    OpenCV turns a TIFF by that tag even if it is told not to.
    """
    stream.seek(0)
    layout = _Layout.of(stream.read(16))
    places = []
    if layout is not None:
        places = [entry.place for entry in _entries(stream, layout) if entry.tag == _ORIENTATION]
    stream.seek(0)
    data = stream.read()
    if layout is None or not places:
        return data
    content = bytearray(data)
    for place in places:
        code = f"{layout.order}{layout.entry}H{layout.field - 2}x"
        struct.pack_into(code, content, place, _ORIENTATION, _SHORT, 1, _UPRIGHT)
    return bytes(content)


def is_greedy(stream: BinaryIO) -> bool:
    """Return whether the tags of a TIFF, or of EXIF, claim more bytes than it can hold.

    Many tags may share the same bytes. A program that reads all tags copies those bytes many times.
    """
    stream.seek(0)
    layout = _Layout.of(stream.read(16))
    if layout is None:
        return False
    entries = list(_entries(stream, layout))
    exif_places = [entry.integer(layout.order) for entry in entries if entry.tag == _EXIF]
    for first in exif_places[:1]:
        entries += _entries(stream, layout, first)
    return sum(_TYPE_BYTES.get(entry.kind, 1) * entry.count for entry in entries) > 2 * stream.seek(
        0, 2
    )


def is_cut_png(data: bytes) -> bool:
    """Return whether this is a PNG with a chunk that goes beyond the end, or without end chunk.

    Some decoders allocate the declared length of a chunk before they notice that the file is
    shorter.
    """
    place, kind = len(_PNG_START), b""
    if data[:place] != _PNG_START:
        return False
    while kind != b"IEND" and place + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        place += length + 12
    return kind != b"IEND" or place > len(data)


def is_cut_jpeg(data: bytes) -> bool:
    """Return whether a JPEG ends before its end is marked."""
    place = len(JPEG_START)
    while marker := _JPEG_MARKER.search(data, place):
        if marker[0] == JPEG_END:
            return False
        # skip the segment: a thumbnail in it has an end of its own
        place = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2])
    return True


def _tiff_size(stream: BinaryIO, layout: _Layout) -> tuple[int, int] | None:
    sizes: dict[int, int] = {}
    for entry in _entries(stream, layout):
        value = entry.integer(layout.order)
        if entry.tag in (_WIDTH, _HEIGHT) and value is not None:
            sizes.setdefault(entry.tag, value)
    return (sizes[_WIDTH], sizes[_HEIGHT]) if len(sizes) == 2 else None


def _entries(stream: BinaryIO, layout: _Layout, first: int | None = None) -> Iterator[_Entry]:
    """Yield the tags of a directory, by default the first image's, up to the end of the file."""
    stream.seek(0)
    try:
        if first is None:
            (first,) = struct.unpack(layout.order + layout.first, stream.read(2 * layout.field))
        place = first + struct.calcsize(layout.order + layout.count)
        stream.seek(first)
        (count,) = struct.unpack(layout.order + layout.count, stream.read(place - first))
        size = struct.calcsize(layout.order + layout.entry)
        for _ in range(min(count, _MAX_TAGS)):
            entry = stream.read(size + layout.field)
            if len(entry) < size + layout.field:
                return
            tag, kind, values = struct.unpack_from(layout.order + layout.entry, entry)
            yield _Entry(place, tag, kind, values, entry[size:])
            place += len(entry)
    except (struct.error, OverflowError, ValueError, OSError):
        return  # the file is cut, or a place is wrong
