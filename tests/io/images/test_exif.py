from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from kgcp.io.images.exif import Exif, read_exif

EXPOSURE_TIME, F_NUMBER, ISO, EXIF_IFD, GPS_IFD = 0x829A, 0x829D, 0x8827, 0x8769, 0x8825
DATE_TIME, OFFSET, SUBSEC, OFFSET_OF_CHANGE = 0x9003, 0x9011, 0x9291, 0x9010
ON_2026_05_04_AT_9_30 = 1777887000.0
WHOLE = {
    EXPOSURE_TIME: TiffImagePlugin.IFDRational(1, 1250),
    F_NUMBER: TiffImagePlugin.IFDRational(28, 10),
    ISO: 200,
    DATE_TIME: "2026:05:04 11:30:05",
    SUBSEC: "05",
    OFFSET: "+02:00",
}


def tagged(path: Path, tags: Mapping[int, object]) -> Path:
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(EXIF_IFD).update(tags)
    Image.new("L", (40, 30)).save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_exposure_and_time_are_read(tmp_path: Path, suffix: str) -> None:
    exif = read_exif(tagged(tmp_path / f"frame{suffix}", WHOLE))
    assert exif.time_s == pytest.approx(ON_2026_05_04_AT_9_30 + 5.05, abs=1e-6)
    assert exif.exposure.exposure_time_s == pytest.approx(0.0008)
    assert exif.exposure.iso == 200.0
    assert exif.exposure.f_number == pytest.approx(2.8)


@pytest.mark.parametrize(
    ("fraction", "seconds"),
    [("5", 0.5), ("05", 0.05), ("050", 0.05), ("123456", 0.123456), (" 25 ", 0.25), ("", 0.0)],
)
def test_sub_seconds_are_a_decimal_fraction(tmp_path: Path, fraction: str, seconds: float) -> None:
    exif = read_exif(tagged(tmp_path / "frame.jpg", {**WHOLE, SUBSEC: fraction}))
    assert exif.time_s == pytest.approx(ON_2026_05_04_AT_9_30 + 5.0 + seconds, abs=1e-6)


@pytest.mark.parametrize("offset", [None, "", "   :  ", "CEST"])
def test_local_time_of_an_unknown_zone_is_no_time(tmp_path: Path, offset: str | None) -> None:
    tags = {tag: value for tag, value in WHOLE.items() if tag != OFFSET}
    exif = read_exif(
        tagged(tmp_path / "frame.jpg", tags if offset is None else {**tags, OFFSET: offset})
    )
    assert exif.time_s is None
    assert exif.exposure.iso == 200.0


@pytest.mark.parametrize(
    ("changed", "expected"),
    [("2026:05:04 11:30:05", ON_2026_05_04_AT_9_30 + 5.05), ("2026:05:11 20:00:00", None)],
)
def test_the_offset_of_the_modification_time_is_used_if_both_times_agree(
    tmp_path: Path, changed: str, expected: float | None
) -> None:
    exif = Image.Exif()
    exif[0x0132] = changed  # DateTime, in the first directory
    exif.get_ifd(EXIF_IFD).update(
        {DATE_TIME: "2026:05:04 11:30:05", SUBSEC: "05", OFFSET_OF_CHANGE: "+02:00"}
    )
    Image.new("L", (40, 30)).save(tmp_path / "frame.jpg", exif=exif.tobytes())
    time_s = read_exif(tmp_path / "frame.jpg").time_s
    assert time_s == (None if expected is None else pytest.approx(expected, abs=1e-6))


def test_utc_offsets_may_be_negative_and_fractional(tmp_path: Path) -> None:
    for offset, hours in (("-03:30", 3.5), ("+05:45", -5.75), ("Z", 0.0), ("+00:00", 0.0)):
        tags = {**WHOLE, DATE_TIME: "2026:05:04 09:30:05", OFFSET: offset}
        time_s = read_exif(tagged(tmp_path / "frame.jpg", tags)).time_s
        expected = ON_2026_05_04_AT_9_30 + 5.05 + 3600.0 * hours
        assert time_s == pytest.approx(expected, abs=1e-6)


def test_gps_time_stamps_are_not_used_as_the_exposure_time(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD)[DATE_TIME] = "2026:05:04 11:30:05"
    exif.get_ifd(GPS_IFD).update({0x001D: "2026:05:04", 0x0007: (9.0, 30.0, 4.0)})
    Image.new("L", (40, 30)).save(tmp_path / "frame.jpg", exif=exif.tobytes())
    assert read_exif(tmp_path / "frame.jpg").time_s is None


@pytest.mark.parametrize(
    "tags",
    [
        {EXPOSURE_TIME: TiffImagePlugin.IFDRational(1, 0), ISO: 0, F_NUMBER: 0.0},
        {DATE_TIME: "0000:00:00 00:00:00", OFFSET: "+00:00"},
        {DATE_TIME: "    :  :     :  :  ", OFFSET: "Z"},
        {OFFSET: "Z", SUBSEC: "5"},
        {DATE_TIME: "yesterday", SUBSEC: "x", OFFSET: "Z"},
    ],
)
def test_senseless_tags_are_ignored(tmp_path: Path, tags: Mapping[int, object]) -> None:
    assert read_exif(tagged(tmp_path / "frame.jpg", tags)) == Exif()


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\xff\xd8\xff\xe1\x00\x20Exif\0\0II*\0\xff\xff"]
)
def test_files_without_exif_have_no_values(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "frame.jpg"
    path.write_bytes(content)
    assert read_exif(path) == Exif()
    assert read_exif(tmp_path / "missing.jpg") == Exif()


def test_large_frames_are_not_refused_as_decompression_bombs(tmp_path: Path) -> None:
    path = tagged(tmp_path / "frame.png", WHOLE)
    data = bytearray(path.read_bytes())
    data[16:24] = (30_000).to_bytes(4, "big") * 2  # IHDR: 900 megapixels
    data[29:33] = __import__("zlib").crc32(data[12:29]).to_bytes(4, "big")
    path.write_bytes(data)
    assert read_exif(path).exposure.iso == 200.0


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(position=st.integers(20, 330), patch=st.binary(min_size=1, max_size=6))
def test_broken_tags_never_raise(tmp_path: Path, position: int, patch: bytes) -> None:
    path = tagged(tmp_path / "frame.jpg", WHOLE)
    data = bytearray(path.read_bytes())
    data[position : position + len(patch)] = patch
    path.write_bytes(data)
    read_exif(path)
