"""Frames that lie: one file among the frames, and the row that it must become."""

from __future__ import annotations

import functools
import os
import socket
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, TiffImagePlugin

from tests.corpus.ground import (
    BROKEN,
    HEIGHT,
    SEEN,
    WIDTH,
    WRONG,
    Case,
    encoded,
    saved,
    sparse,
    texture,
)

_GREY = texture()
_OTHER = Image.fromarray(255 - _GREY)
_COLOUR = np.dstack((_GREY, 255 - _GREY, _GREY))
_JPEG = encoded(".jpg")
_TIFF_HEAD = saved("TIFF")[:400]
_TWO: dict[str, Any] = {"save_all": True, "append_images": [_OTHER]}


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@functools.cache
def _deflated(data: bytes) -> bytes:
    return zlib.compress(data, 1)  # the best compression of many zeros takes long


def png(width: int, height: int, *chunks: bytes, rows: bytes = b"") -> bytes:
    """A PNG that says to be of this size, whatever its rows are."""
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    body = _chunk(b"IDAT", _deflated(rows)) + _chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + body


def _resized(data: bytes, width: int, height: int) -> bytes:
    """Make a JPEG's frame header lie about the size."""
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", height, width) + data[place + 4 :]


def tiff(width: int, height: int) -> bytes:
    """A TIFF of one strip that is not there, large as it says to be."""
    tags = ((256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1))
    more = ((278, height), (279, 1))
    entries = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in (*tags, *more)]
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(entries) + bytes(4)


def _bmp(width: int, height: int) -> bytes:
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + head


def _exif(tags: Mapping[int, object]) -> bytes:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    return saved("JPEG", exif=exif.tobytes())


def _stretched_codestream() -> bytes:
    """A JPEG 2000 whose codestream is of another size than its box says, and larger."""
    data = saved("JPEG2000", num_resolutions=2)
    place = data.index(b"\xff\x4f\xff\x51") + 8
    return data[:place] + struct.pack(">II", 60_000, 60_000) + data[place + 8 :]


_LATE = "9999:12:31 23:59:59"
_EARLY = "0001:01:01 00:00:00"
CONTENTS: Mapping[str, tuple[str, bytes, str]] = {
    # what is no image, whatever it is called
    "zero bytes": ("a.jpg", b"", BROKEN),
    "one byte": ("a.png", b"\xff", BROKEN),
    "text": ("a.jpg", b"not an image\n", BROKEN),
    "a page": ("a.tif", b"<html><script>alert(1)</script></html>", BROKEN),
    "a program": ("a.png", b"\x7fELF" + bytes(500), BROKEN),
    "zeros": ("a.jpg", bytes(5000), BROKEN),
    "noise": ("a.webp", np.random.default_rng(1).bytes(5000), BROKEN),
    "a magic number alone": ("a.jp2", b"\0\0\0\x0cjP  \r\n\x87\n", BROKEN),
    # cut
    "half a JPEG": ("a.jpg", _JPEG[: len(_JPEG) // 2], BROKEN),
    "half a PNG": ("a.png", encoded(".png")[:900], BROKEN),
    "half a TIFF": ("a.tif", encoded(".tif")[:900], BROKEN),
    "half a WebP": ("a.webp", saved("WEBP")[:200], BROKEN),
    "half a JPEG 2000": ("a.jp2", saved("JPEG2000", num_resolutions=2)[:120], BROKEN),
    "half a BMP": ("a.bmp", encoded(".bmp")[:900], BROKEN),
    "half a PGM": ("a.pgm", encoded(".pgm")[:900], BROKEN),
    "a JPEG with a hole": ("a.jpg", _JPEG[:900] + _JPEG[1000:], BROKEN),
    # mislabelled: the content decides
    "a JPEG called PNG": ("a.png", _JPEG, SEEN),
    "a PNG called JPEG": ("a.JPEG", encoded(".png"), SEEN),
    "a TIFF called BMP": ("a.bmp", encoded(".tif"), SEEN),
    "a GIF called JPEG": ("a.jpg", saved("GIF"), BROKEN),
    "an icon called PNG": ("a.png", saved("ICO"), BROKEN),
    # several images: the first counts
    "an animated PNG": ("a.png", saved("PNG", **_TWO), SEEN),
    "an animated WebP": ("a.webp", saved("WEBP", **_TWO), SEEN),
    "an animated GIF": ("a.webp", saved("GIF", **_TWO), BROKEN),
    "a TIFF of two pages": ("a.tif", saved("TIFF", **_TWO), SEEN),
    "a JPEG with a second one": ("a.jpg", saved("MPO", **_TWO), SEEN),
    # pixels of other kinds
    "CMYK": ("a.jpg", saved("JPEG", Image.fromarray(_COLOUR).convert("CMYK")), SEEN),
    "16 bits": ("a.png", encoded(".png", texture(np.uint16)), SEEN),
    "16 bits in a TIFF": ("a.tif", encoded(".tif", texture(np.uint16)), SEEN),
    "alpha": ("a.png", encoded(".png", np.dstack((_COLOUR, _GREY))), SEEN),
    "floating point": ("a.tif", encoded(".tif", _GREY.astype(np.float32)), BROKEN),
    "a palette": ("a.png", saved("PNG", Image.fromarray(_COLOUR).quantize(16)), SEEN),
    "two levels": ("a.tif", saved("TIFF", Image.fromarray(_GREY > 99), compression="group4"), SEEN),
    "progressive": ("a.jpg", encoded(".jpg", None, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), SEEN),
    "turned by EXIF": ("a.jpg", saved("JPEG", exif=b"Exif\0\0" + _exif({})[26:60]), SEEN),
    "a TIFF turned by its tag": ("a.tif", saved("TIFF", tiffinfo={274: 6}), SEEN),
    # sizes: known before anything is decoded
    "one pixel": ("a.png", encoded(".png", np.zeros((1, 1), np.uint8)), WRONG),
    "65 000 pixels wide": ("a.png", encoded(".png", np.zeros((1, 65_000), np.uint8)), WRONG),
    "width and height swapped": ("a.png", encoded(".png", _GREY.T.copy()), WRONG),
    "a PNG of 4e9 pixels": ("a.png", png(65_000, 65_000, rows=bytes(1 << 20)), WRONG),
    "a PNG of 2^62 pixels": ("a.png", png(2**31 - 1, 2**31 - 1), WRONG),
    "a PNG of no pixels": ("a.png", png(0, 0), BROKEN),
    "a JPEG of 4e9 pixels": ("a.jpg", _resized(_JPEG, 65_500, 65_500), WRONG),
    "a TIFF of 2^64 pixels": ("a.tif", tiff(2**32 - 1, 2**32 - 1), WRONG),
    "a TIFF without pixels": ("a.tif", tiff(WIDTH, HEIGHT), BROKEN),
    "a BMP of 4e18 pixels": ("a.bmp", _bmp(2**31 - 1, 2**31 - 1), WRONG),
    "a BMP of -1 rows": ("a.bmp", _bmp(WIDTH, -1), WRONG),
    "a PPM of 1e12 pixels": ("a.ppm", b"P6\n1000000 1000000\n255\n", WRONG),
    "a PPM of a size without end": ("a.ppm", b"P6\n" + b"9" * 100_000 + b" 1\n255\n", BROKEN),
    "a JPEG 2000 of two sizes": ("a.jp2", _stretched_codestream(), BROKEN),
    "rows that inflate": ("a.png", png(WIDTH, HEIGHT, rows=bytes(50 << 20)), SEEN),
    "a comment that inflates": (
        "a.png",
        png(WIDTH, HEIGHT, _chunk(b"zTXt", b"c\0\0" + _deflated(bytes(50 << 20)))),
        BROKEN,
    ),
    # EXIF
    "EXIF of noise": ("a.jpg", saved("JPEG", exif=b"Exif\0\0II*\0" + b"\xfe" * 400), SEEN),
    "EXIF without end": (
        "a.jpg",
        saved("JPEG", exif=b"Exif\0\0II*\0\x08\0\0\0" + b"\xff\xff" + bytes(60)),
        SEEN,
    ),
    "an exposure of 0/0": ("a.jpg", _exif({0x829A: TiffImagePlugin.IFDRational(0, 0)}), SEEN),
    "a date that is none": ("a.jpg", _exif({0x9003: "0000:99:99 77:77", 0x9011: "+99:99"}), SEEN),
    "the last date": ("a.jpg", _exif({0x9003: _LATE, 0x9011: "-23:59"}), SEEN),
    "the first date": ("a.jpg", _exif({0x9003: _EARLY, 0x9011: "+23:59"}), SEEN),
    "a date of digits": ("a.jpg", _exif({0x9003: "9" * 60_000, 0x9011: "Z"}), SEEN),
}
NAMES = (
    *(" a .png", "new\nline.png", 'tab\tquote".png', "ø ̈ 日本 🛰.png", "-rf.png", "%s{0}$(x).png"),
    *("<script>alert(1)</script>.png".replace("/", ":"), "\x1b[2J.png", "n" * 251 + ".png"),
    "CON.PnG",
)


def _file(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda flight: (flight / "frames" / name).write_bytes(data)


def _link(name: str, leads_to: str) -> Callable[[Path], object]:
    return lambda flight: (flight / "frames" / name).symlink_to(leads_to)


def _gigabyte(head: bytes) -> Callable[[Path], object]:
    return lambda flight: sparse(flight / "frames" / "a.tif", head)


def _fifo(flight: Path) -> None:
    os.mkfifo(flight / "frames" / "a.jpg")


def _socket(flight: Path) -> None:
    here = Path.cwd()
    os.chdir(flight / "frames")  # a socket's whole path must be short
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind("a.jpg")
    finally:
        os.chdir(here)


def _folder(flight: Path) -> None:
    (flight / "frames" / "a.jpg").mkdir()
    (flight / "frames" / "a.jpg" / "b.png").write_bytes(encoded(".png"))


def _undecodable_name(flight: Path) -> None:
    Path(os.fsdecode(os.fsencode(flight / "frames") + b"/\xff\xfe.png")).write_bytes(b"")


CASES = (
    *(
        Case(name, _file(file, data), rows={file: row})
        for name, (file, data, row) in CONTENTS.items()
    ),
    *(
        Case(f"called {name!r:.20}", _file(name, encoded(".png")), rows={name: SEEN})
        for name in NAMES
    ),
    Case("a name that is not UTF-8", _undecodable_name, "is not UTF-8; rename the file"),
    Case("a hidden file", _file(".a.png", b""), rows={}),
    Case("a link to itself", _link("a.png", "a.png"), rows={"a.png": BROKEN}),
    Case("a link to nothing", _link("a.png", "gone.png"), rows={"a.png": BROKEN}),
    Case("a link to a frame", _link("a.png", "../../elsewhere/other.png"), rows={"a.png": SEEN}),
    Case("a link to zeros without end", _link("a.png", "/dev/zero"), rows={"a.png": BROKEN}),
    Case("a link to a text", _link("a.png", "/etc/passwd"), rows={"a.png": BROKEN}),
    Case("a link to a folder", _link("a.png", "../../elsewhere"), rows={}),
    Case("a link to the folder above", _link("above", ".."), rows={}),
    Case("a pipe", _fifo, rows={"a.jpg": BROKEN}),
    Case("a socket", _socket, rows={"a.jpg": BROKEN}),
    Case("a folder called a frame", _folder, rows={"a.jpg/b.png": SEEN}),
    *(
        Case(
            f"a gigabyte after {head[:4]!r}",
            _gigabyte(head),
            rows={"a.tif": BROKEN},
            is_huge=True,
        )
        for head in (b"", _JPEG, _TIFF_HEAD, encoded(".png"), b"P5\n64 48\n255\n")
    ),
)
