"""Values from frame headers: size, maker, focal length, position and altitude."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from kgcp.io.images.exif import read_frame_header
from kgcp.quality.checks.frame_header import FrameHeader

XMP = b'<x:xmpmeta><rdf:Description drone-dji:RelativeAltitude="%s"/></x:xmpmeta>'


PLACE = ((46.0, 50.0, 34.5), (91.0, 59.0, 38.25))
ZERO = (0.0, 0.0, 0.0)


def write(
    path: Path,
    altitude: bytes = b"+40.10",
    latitude: str = "N",
    place: tuple[tuple[float, ...], tuple[float, ...]] = PLACE,
) -> None:
    image = Image.fromarray(np.full((48, 64), 90, dtype=np.uint8))
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "DJI\0", "FC300S"
    exif.get_ifd(IFD.Exif).update({Base.FocalLength: 3.61, Base.FocalLengthIn35mmFilm: 20})
    exif.get_ifd(IFD.GPSInfo).update(
        {
            GPS.GPSLatitudeRef: latitude,
            GPS.GPSLatitude: place[0],
            GPS.GPSLongitudeRef: "W",
            GPS.GPSLongitude: place[1],
        }
    )
    image.save(path, exif=exif, xmp=XMP % altitude)


def test_position_and_camera_are_read_from_a_drone_s_frame(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg")
    header = read_frame_header(tmp_path / "a.jpg", "day/a.jpg")
    assert (header.frame, header.size_px) == ("day/a.jpg", (64, 48))
    assert header.camera == "DJI FC300S"
    assert header.focal_mm == pytest.approx(3.61)
    assert header.focal_35_mm == 20.0
    assert header.latitude_deg == pytest.approx(46.84292, abs=1e-5)
    assert header.longitude_deg == pytest.approx(-91.99396, abs=1e-5)
    assert header.altitude_m == pytest.approx(40.1)


def test_southern_latitudes_and_negative_altitudes_are_read(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", b"-3.5", "S")
    header = read_frame_header(tmp_path / "a.jpg", "a.jpg")
    assert header.latitude_deg == pytest.approx(-46.84292, abs=1e-5)
    assert header.altitude_m == -3.5


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((PLACE[0], ZERO), (pytest.approx(46.84292, abs=1e-5), 0.0)),  # on Greenwich's meridian
        ((ZERO, PLACE[1]), (0.0, pytest.approx(-91.99396, abs=1e-5))),  # on the equator
        ((ZERO, ZERO), (None, None)),  # no fix
    ],
)
def test_a_position_with_one_angle_of_zero_is_valid(
    tmp_path: Path,
    place: tuple[tuple[float, ...], tuple[float, ...]],
    expected: tuple[object, object],
) -> None:
    write(tmp_path / "a.jpg", place=place)
    header = read_frame_header(tmp_path / "a.jpg", "a.jpg")
    assert (header.latitude_deg, header.longitude_deg) == expected


def test_missing_or_damaged_values_are_none(tmp_path: Path) -> None:
    assert read_frame_header(tmp_path / "gone.jpg", "gone.jpg") == FrameHeader("gone.jpg")
    (tmp_path / "noise.jpg").write_bytes(bytes(range(256)))
    assert read_frame_header(tmp_path / "noise.jpg", "n") == FrameHeader("n")
    Image.fromarray(np.zeros((48, 64), dtype=np.uint8)).save(tmp_path / "plain.png")
    assert read_frame_header(tmp_path / "plain.png", "p") == FrameHeader("p", (64, 48))
    write(tmp_path / "a.jpg", b"high")
    assert read_frame_header(tmp_path / "a.jpg", "a").altitude_m is None
    Image.fromarray(np.zeros((48, 64), dtype=np.uint8)).save(tmp_path / "plain.tif")
    assert read_frame_header(tmp_path / "plain.tif", "t") == FrameHeader("t", (64, 48))


@pytest.mark.parametrize(
    ("tags", "focal_px"),
    [
        ({Base.FocalPlaneXResolution: 16393.44, Base.FocalPlaneResolutionUnit: 2}, 46.47),
        ({Base.FocalPlaneXResolution: 16393.44}, 46.47),  # inches unless it says otherwise
        ({Base.FocalPlaneXResolution: 6454.1, Base.FocalPlaneResolutionUnit: 3}, 46.47),
        ({Base.FocalPlaneXResolution: 16393.44, Base.FocalPlaneResolutionUnit: 9}, None),
        ({Base.FocalPlaneXResolution: 0.0}, None),
    ],
)
def test_the_focal_length_in_pixels_of_a_resized_frame(
    tmp_path: Path, tags: dict[int, float], focal_px: float | None
) -> None:
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update({Base.FocalLength: 4.5, Base.ExifImageWidth: 4000, **tags})
    Image.fromarray(np.zeros((48, 64), dtype=np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    found = read_frame_header(tmp_path / "a.jpg", "a.jpg").focal_px
    assert found == (None if focal_px is None else pytest.approx(focal_px, abs=0.01))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_size_of_a_tiff_is_that_of_its_stored_pixels(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "a.tif"
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(path, tiffinfo={274: orientation})
    assert read_frame_header(path, "a").size_px == (64, 48)
