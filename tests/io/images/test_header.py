from __future__ import annotations

import struct
import tracemalloc
from io import BytesIO
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kgcp.io.images.exif import Exif, read_exif
from kgcp.io.images.header import image_size, is_greedy, misread_pixels, with_stored_pixels

SIZE = (43, 29)


def saved(form: str, **options: object) -> bytes:
    stream = BytesIO()
    Image.new("L", SIZE, 99).save(stream, form, **options)
    return stream.getvalue()


@pytest.mark.parametrize("form", ["BMP", "JPEG", "PNG", "PPM", "TIFF", "WEBP"])
def test_the_size_of_a_frame_is_read_from_its_header(form: str) -> None:
    data = saved(form)
    assert image_size(BytesIO(data)) == SIZE
    assert with_stored_pixels(BytesIO(data)) == data
    assert image_size(BytesIO(data[:5])) is None


def test_files_that_cannot_be_frames_have_no_size() -> None:
    assert image_size(BytesIO(saved("GIF"))) is None
    assert image_size(BytesIO(b"")) is None


@pytest.mark.parametrize("is_big", [False, True])
def test_a_tiff_s_orientation_is_overwritten_and_nothing_else(*, is_big: bool) -> None:
    turned = saved("TIFF", tiffinfo={274: 6}, big_tiff=is_big)
    made = with_stored_pixels(BytesIO(turned))
    assert len(made) == len(turned)
    assert sum(one != other for one, other in zip(made, turned, strict=True)) == 1
    with Image.open(BytesIO(made)) as image:
        assert image.size == SIZE
        assert image.getexif()[274] == 1


@given(
    head=st.sampled_from([saved("TIFF", big_tiff=True), saved("TIFF"), b"MM\0*", b"MM\0+", b""]),
    place=st.integers(0, 300),
    noise=st.binary(max_size=60),
)
def test_damaged_headers_raise_no_exception(head: bytes, place: int, noise: bytes) -> None:
    data = head[:place] + noise + head[place + len(noise) :]
    size = image_size(BytesIO(data))
    assert size is None or len(size) == 2
    assert len(with_stored_pixels(BytesIO(data))) == len(data)
    assert isinstance(misread_pixels(BytesIO(data)), str)


def tags_of_the_same_bytes(count: int, size: int, start: int) -> bytes:
    """A TIFF whose tags all refer to its last bytes."""
    entries = b"".join(struct.pack("<HHII", 40_000 + n, 7, size, start) for n in range(count))
    head = b"II*\0" + struct.pack("<IH", 8, count) + entries + bytes(4)
    return head + bytes(max(start + size - len(head), 0))


def test_tags_that_share_their_bytes_are_not_read(tmp_path: Path) -> None:
    greedy = tags_of_the_same_bytes(1000, 1 << 16, 1 << 15)
    assert is_greedy(BytesIO(greedy))
    assert not is_greedy(BytesIO(tags_of_the_same_bytes(1, 1 << 16, 1 << 15)))
    assert not any(is_greedy(BytesIO(saved(form))) for form in ("TIFF", "JPEG"))
    exif = Image.Exif()
    exif.get_ifd(34665)[37510] = b"a comment" * 100
    assert not is_greedy(BytesIO(exif.tobytes().removeprefix(b"Exif\0\0")))
    path = tmp_path / "frame.png"
    path.write_bytes(saved("PNG", exif=b"Exif\0\0" + greedy))
    tracemalloc.start()
    assert read_exif(path) == Exif()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5_000_000  # and not 65 MB
