"""What a camera writes about a frame: exposure and time, from EXIF."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, SupportsFloat

from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from kgcp.errors import SettingError
from kgcp.io.files.safe_read import is_file
from kgcp.io.files.time_text import parse_time
from kgcp.io.images.header import FORMATS, image_size, is_greedy
from kgcp.measurement.records import ExposureSettings
from kgcp.quality.checks.frame_header import FrameHeader

_EXIF_MARK = b"Exif\0\0"
_INCH = 2.0
_UNITS_MM = {_INCH: 25.4, 3.0: 10.0, 4.0: 1.0}  # of length, by their number in EXIF
_RELATIVE_ALTITUDE = re.compile(
    rb"""drone-dji:RelativeAltitude(?:="|>)\s*([+-]?\d{1,5}(?:\.\d{0,9})?)"""
)


@dataclass(frozen=True, slots=True)
class Exif:
    """Exposure and time of one frame; None where the tag is absent or makes no sense."""

    # Unix seconds (UTC) of DateTimeOriginal: when the camera says it took the frame
    time_s: float | None = None
    exposure: ExposureSettings = field(default_factory=ExposureSettings)


def read_exif(path: Path) -> Exif:
    """Read exposure and time of a frame without decoding its pixels.

    The time is DateTimeOriginal with SubSecTimeOriginal, a decimal fraction ("05" is 0.05 s), and
    OffsetTimeOriginal. If that is absent, OffsetTime is used. It belongs to DateTime, which must be
    the same moment, as in an unedited file. A time without offset is local to an unknown place and
    is ignored. GPS stamps are ignored, too: they are UTC, but of the receiver's last fix, and
    mostly in whole seconds, in which a vehicle moves by metres.

    Damaged or absent values are None; nothing is raised.
    """
    if not is_file(path):  # opening a pipe would wait for ever
        return Exif()
    try:
        with warnings.catch_warnings(action="ignore"):
            tags = _exif_tags(path).main
    except Exception:  # damaged headers make Pillow raise any kind of exception
        return Exif()
    exposure = ExposureSettings(
        exposure_time_s=_positive(tags.get(Base.ExposureTime)),
        iso=_positive(tags.get(Base.ISOSpeedRatings)),
        f_number=_positive(tags.get(Base.FNumber)),
    )
    return Exif(_time_s(tags), exposure)


@dataclass(frozen=True, slots=True)
class _Tags:
    """Metadata of a file: main part and GPS part of its EXIF, and raw XMP."""

    main: Mapping[int, Any] = field(default_factory=dict)
    gps: Mapping[int, Any] = field(default_factory=dict)
    xmp: bytes = b""


def load_formats() -> None:
    """Load Pillow's formats, which would otherwise delay the first file by 30 ms."""
    Image.init()


def _exif_tags(path: Path) -> _Tags:
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # the limit guards decoding; aerial cameras exceed it
    try:
        with path.open("rb") as stream:
            if is_greedy(stream):
                return _Tags()
        with Image.open(path, "r", (*FORMATS, "TIFF")) as image:
            if is_greedy(BytesIO(image.info.get("exif", b"").removeprefix(_EXIF_MARK))):
                return _Tags()
            # The method of the base class: that of PNG would decode all pixels.
            exif = Image.Image.getexif(image)
            xmp = image.info.get("xmp", b"")
            return _Tags(
                {**exif, **exif.get_ifd(IFD.Exif)},
                exif.get_ifd(IFD.GPSInfo),
                xmp if isinstance(xmp, bytes) else b"",
            )
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def read_frame_header(path: Path, frame: str) -> FrameHeader:
    """Read what the header of a frame says, without decoding its pixels.

    Damaged or absent values are None; nothing is raised.
    """
    if not is_file(path):
        return FrameHeader(frame)
    try:
        with warnings.catch_warnings(action="ignore"):
            tags = _exif_tags(path)
        texts = (_text(tags.main, tag) for tag in (Base.Make, Base.Model, Base.BodySerialNumber))
        longitude_deg = _angle_deg(tags.gps, GPS.GPSLongitude, GPS.GPSLongitudeRef, "W", 180.0)
        latitude_deg = _angle_deg(tags.gps, GPS.GPSLatitude, GPS.GPSLatitudeRef, "S", 90.0)
        has_position = longitude_deg is not None and latitude_deg is not None
        if longitude_deg == latitude_deg == 0.0:  # written by cameras without a fix
            has_position = False
        size_px = _size_px(path)
        return FrameHeader(
            frame,
            size_px,
            camera=" ".join(filter(None, texts)),
            focal_mm=_positive(tags.main.get(Base.FocalLength)),
            focal_35_mm=_positive(tags.main.get(Base.FocalLengthIn35mmFilm)),
            focal_px=_focal_px(tags.main, size_px),
            time_s=_time_s(tags.main),
            clock_s=_original_s(tags.main, "Z"),
            longitude_deg=longitude_deg if has_position else None,
            latitude_deg=latitude_deg if has_position else None,
            altitude_m=_altitude_m(tags.xmp),
        )
    except Exception:  # damaged headers make Pillow raise any kind of exception
        return FrameHeader(frame, _size_px(path))


def _focal_px(tags: Mapping[int, Any], size_px: tuple[int, int] | None) -> float | None:
    """Return the focal length by the resolution of the focal plane, scaled to a resized frame."""
    focal_mm = _positive(tags.get(Base.FocalLength))
    px_per_unit = _positive(tags.get(Base.FocalPlaneXResolution))
    unit_mm = _UNITS_MM.get(_positive(tags.get(Base.FocalPlaneResolutionUnit)) or _INCH)
    if focal_mm is None or px_per_unit is None or unit_mm is None or size_px is None:
        return None
    original_px = _positive(tags.get(Base.ExifImageWidth)) or size_px[0]
    return focal_mm * px_per_unit / unit_mm * size_px[0] / original_px


def _size_px(path: Path) -> tuple[int, int] | None:
    """Return width and height as they are stored; Pillow turns those of a TIFF by its tag."""
    try:
        with path.open("rb") as stream:
            return image_size(stream)
    except OSError:
        return None


def _angle_deg(
    gps: Mapping[int, Any], tag: GPS, reference: GPS, negative: str, limit: float
) -> float | None:
    """Return a longitude or latitude of degrees, minutes and seconds."""
    parts = gps.get(tag)
    if not isinstance(parts, tuple) or len(parts) != 3:
        return None
    degrees = sum(float(part) / 60.0**power for power, part in enumerate(parts))
    if not 0.0 <= degrees <= limit:
        return None
    return -degrees if _text(gps, reference).upper() == negative else degrees


def _altitude_m(xmp: bytes) -> float | None:
    """Return the altitude above the take-off point, as DJI's drones write it."""
    match = _RELATIVE_ALTITUDE.search(xmp)
    return None if match is None else float(match[1])


def _positive(value: object) -> float | None:
    """Return the first number of a tag if it is finite and positive."""
    first = value[0] if isinstance(value, tuple) and value else value
    if not isinstance(first, SupportsFloat):
        return None
    number = float(first)  # a rational with denominator 0 becomes NaN
    return number if math.isfinite(number) and number > 0.0 else None


def _time_s(tags: Mapping[int, Any]) -> float | None:
    offset = _text(tags, Base.OffsetTimeOriginal)
    if not offset and _text(tags, Base.DateTime) == _text(tags, Base.DateTimeOriginal):
        offset = _text(tags, Base.OffsetTime)
    return _original_s(tags, offset) if offset else None


def _original_s(tags: Mapping[int, Any], offset: str) -> float | None:
    """Return DateTimeOriginal, with its fraction, as Unix seconds if that is its offset."""
    day, _, clock = _text(tags, Base.DateTimeOriginal).partition(" ")
    fraction = _text(tags, Base.SubsecTimeOriginal)
    seconds = f"{clock}.{fraction}" if fraction else clock
    try:
        return parse_time(f"{day.replace(':', '-')}T{seconds}{offset}")
    except SettingError:
        return None


def _text(tags: Mapping[int, Any], tag: Base | GPS) -> str:
    return str(tags.get(tag, "")).strip(" \0")
