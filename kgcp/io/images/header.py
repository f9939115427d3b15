"""What the header of an image says, before its pixels are decoded or even read.

Pillow gives sizes except those of TIFFs: it refuses pixels that frames may have (16-bit RGB), and
reads every tag on opening. So this module reads the directory of a TIFF itself, by TIFF 6.0,
section 2, and by BigTIFF, which counts with 8 bytes where TIFF has 2 or 4. The directory also has
the orientation and the layout of the pixels, and shows whether tags claim more bytes than the file
has.
"""

from __future__ import annotations

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
_PNG_START = b"\x89PNG\r\n\x1a\n"
_WIDTH, _HEIGHT, _ORIENTATION, _EXIF = 256, 257, 274, 34665
_BITS, _PHOTOMETRIC, _SAMPLES, _PLANES, _EXTRA_SAMPLES = 258, 262, 277, 284, 338
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2
_CONTIGUOUS, _SEPARATE = 1, 2
_BYTE_BITS = 8
# Values of tags by which OpenCV would change pixels. 0: nothing is said about the extra sample;
# OpenCV multiplies colours by one that is said to be their opacity.
_NEUTRAL = {_ORIENTATION: 1, _EXTRA_SAMPLES: 0}
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


def with_stored_pixels(stream: BinaryIO) -> bytes:
    """Return the content of a file; in a TIFF, tags that change pixels are made neutral.

    OpenCV turns a TIFF by its orientation even if it is told not to, and darkens it by its opacity.
    """
    stream.seek(0)
    layout = _Layout.of(stream.read(16))
    entries: list[_Entry] = []
    if layout is not None:
        entries = [entry for entry in _entries(stream, layout) if entry.tag in _NEUTRAL]
    stream.seek(0)
    data = stream.read()
    if layout is None or not entries:
        return data
    content = bytearray(data)
    code = f"{layout.order}{layout.entry}H{layout.field - 2}x"
    for entry in entries:
        if entry.tag == _ORIENTATION or entry.count == 1:
            struct.pack_into(code, content, entry.place, entry.tag, _SHORT, 1, _NEUTRAL[entry.tag])
    return bytes(content)


def misread_pixels(stream: BinaryIO) -> str:
    """Return which pixels of a TIFF OpenCV would read wrong without an error; "" if it would not.

    Of more than 8 bits it reads only grey values with black as 0, and red, green and blue side by
    side, with or without opacity.
    """
    stream.seek(0)
    layout = _Layout.of(stream.read(16))
    if layout is None:
        return ""
    entries = {entry.tag: entry for entry in reversed([*_entries(stream, layout)])}
    values = {tag: entry.integer(layout.order) for tag, entry in entries.items()}
    bits = _bits(stream, layout, entries[_BITS]) if _BITS in entries else 1
    samples, photometric = values.get(_SAMPLES, 1), values.get(_PHOTOMETRIC)
    if bits <= _BYTE_BITS or photometric is None:
        return ""
    if samples != 1 and values.get(_PLANES, _CONTIGUOUS) == _SEPARATE:
        return f"separate planes of {bits} bits"
    if photometric == _WHITE_IS_ZERO:
        return f"grey values of {bits} bits with white as 0"
    if (photometric, samples) in {(_BLACK_IS_ZERO, 1), (_RGB, 3), (_RGB, 4)}:
        return ""
    return f"channels of {bits} bits that are neither grey nor RGB"


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


def _bits(stream: BinaryIO, layout: _Layout, entry: _Entry) -> int:
    """Return the bits of the first channel; 0 if the file does not hold them."""
    values = entry.value
    try:
        if 2 * entry.count > layout.field:  # they are elsewhere in the file
            (place,) = struct.unpack(layout.order + layout.first[-1], values)
            stream.seek(place)
            values = stream.read(2)
        return int(struct.unpack_from(f"{layout.order}H", values)[0])
    except (struct.error, OverflowError, ValueError, OSError):
        return 0


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
