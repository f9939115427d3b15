"""What a camera writes about a frame: exposure and time, from EXIF."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, SupportsFloat

from PIL import Image
from PIL.ExifTags import IFD, Base

from kgcp.errors import SettingError
from kgcp.io.files.safe_read import is_file
from kgcp.io.files.time_text import parse_time
from kgcp.io.images.header import FORMATS, is_greedy
from kgcp.measurement.records import ExposureSettings

_EXIF_MARK = b"Exif\0\0"


@dataclass(frozen=True, slots=True)
class Exif:
    """Exposure and time of one frame; None where the tag is absent or makes no sense.

    Attributes
    ----------
    time_s : float or None
        Unix seconds (UTC) of DateTimeOriginal: when the camera says it took the frame.
    exposure : ExposureSettings
    """

    time_s: float | None = None
    exposure: ExposureSettings = field(default_factory=ExposureSettings)


def read_exif(path: Path) -> Exif:
    """Read exposure and time of a frame without decoding its pixels.

    The time is DateTimeOriginal with SubSecTimeOriginal, a decimal fraction ("05" is 0.05 s), and
    OffsetTimeOriginal. Where that is absent, OffsetTime serves, which is DateTime's, if DateTime
    is the same moment (in an unedited file). Without an offset it is the local time of
    an unknown place and is left out. So are the GPS stamps: they are UTC, but of the receiver's
    last fix and mostly in whole seconds, in which a vehicle goes metres.

    Whatever is damaged or absent is None; nothing is raised.
    """
    if not is_file(path):  # opening a pipe would wait for ever
        return Exif()
    try:
        with warnings.catch_warnings(action="ignore"):
            tags = _exif_tags(path)
    except Exception:  # Pillow's parsers raise whatever a damaged header makes them stumble over
        return Exif()
    exposure = ExposureSettings(
        exposure_time_s=_positive(tags.get(Base.ExposureTime)),
        iso=_positive(tags.get(Base.ISOSpeedRatings)),
        f_number=_positive(tags.get(Base.FNumber)),
    )
    return Exif(_time_s(tags), exposure)


def _exif_tags(path: Path) -> Mapping[int, Any]:
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # the limit guards decoding; aerial cameras exceed it
    try:
        with path.open("rb") as stream:
            if is_greedy(stream):
                return {}
        with Image.open(path, "r", (*FORMATS, "TIFF")) as image:
            if is_greedy(BytesIO(image.info.get("exif", b"").removeprefix(_EXIF_MARK))):
                return {}
            # The method of the base class: that of PNG would decode all pixels.
            exif = Image.Image.getexif(image)
            return {**exif, **exif.get_ifd(IFD.Exif)}
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _positive(value: object) -> float | None:
    """Return the first number of a tag, if it is one that a camera can have."""
    first = value[0] if isinstance(value, tuple) and value else value
    if not isinstance(first, SupportsFloat):
        return None
    number = float(first)  # a rational with denominator 0 becomes NaN
    return number if math.isfinite(number) and number > 0.0 else None


def _time_s(tags: Mapping[int, Any]) -> float | None:
    day, _, clock = _text(tags, Base.DateTimeOriginal).partition(" ")
    fraction = _text(tags, Base.SubsecTimeOriginal)
    offset = _text(tags, Base.OffsetTimeOriginal)
    if not offset and _text(tags, Base.DateTime) == _text(tags, Base.DateTimeOriginal):
        offset = _text(tags, Base.OffsetTime)
    if not offset:
        return None
    seconds = f"{clock}.{fraction}" if fraction else clock
    try:
        return parse_time(f"{day.replace(':', '-')}T{seconds}{offset}")
    except SettingError:
        return None


def _text(tags: Mapping[int, Any], tag: Base) -> str:
    return str(tags.get(tag, "")).strip(" \0")
