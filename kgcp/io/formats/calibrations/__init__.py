"""Camera calibrations as other programs write them, one module per format.

Each module has one line in `FORMATS` and offers two functions. `matches(file)` says whether the
content has its format, `entries(file)` returns its cameras. `entries` raises `KgcpError`, which
names the line or element, if a file does not follow its format.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations import (
    colmap,
    dji,
    metashape,
    mmvii,
    opencv,
    opensfm,
    opf,
    pix4d,
    ros,
    visiona,
)
from kgcp.io.formats.calibrations.entry import Entry
from kgcp.io.formats.registry import Registry
from kgcp.quality.number_text import listed

FORMATS: Registry[Callable[[ForeignFile], Sequence[Entry]]] = Registry(
    "a calibration",
    "convert it or write the values to [camera]",
    {
        "opf": (opf.matches, opf.entries),
        "opensfm": (opensfm.matches, opensfm.entries),
        "mmvii": (mmvii.matches, mmvii.entries),
        "metashape": (metashape.matches, metashape.entries),
        "dji": (dji.matches, dji.entries),
        "pix4d": (pix4d.matches, pix4d.entries),
        "visiona": (visiona.matches, visiona.entries),
        "colmap": (colmap.matches, colmap.entries),
        "opencv": (opencv.matches, opencv.entries),
        "ros": (ros.matches, ros.entries),
    },
)

_MAX_NAMED = 8  # cameras in a message


@dataclass(frozen=True, slots=True)
class ErrorWords:
    """Wording of errors about a calibration file, depending on what names the file."""

    named_by: str  # the key or option that names the file
    other_size: str  # what its frame size contradicts
    # remedies
    no_size: str
    several_cameras: str
    other_format: str


OF_FLIGHT = ErrorWords(
    named_by="[camera] file",
    other_size="but [camera] says",
    no_size="add width and height to [camera]",
    several_cameras="choose one with [camera] camera",
    other_format=FORMATS.remedy,
)
"""For a file that flight.toml names."""


def read_calibration(
    path: Path,
    stated_size: tuple[int | None, int | None],
    form: str | None = None,
    camera: str | None = None,
    words: ErrorWords = OF_FLIGHT,
) -> Camera:
    """Read a calibration file of one of the `FORMATS`; docs/foreign_files.md has their conversions.

    Parameters
    ----------
    stated_size : tuple of int or None
        Width and height [px] that are known from elsewhere. They are needed if the file has none;
        otherwise they must agree.
    form : str or None
        Name of the format; None: the content tells.
    camera : str or None
        Name of the camera where the file has several.
    words : ErrorWords
        Wording of errors.

    Raises
    ------
    KgcpError
        If the file is missing, is of no known format, lacks the size or the camera, or holds a
        model that `Camera` cannot represent exactly. The message names the term.
    """
    file = ForeignFile(path, words.named_by)
    read = replace(FORMATS, remedy=words.other_format).reader(file, form)
    entry = _chosen(file, read(file), camera, words)
    width, height = _agreed_size(file, entry, stated_size, words)
    try:
        return entry.convert(width, height)
    except SettingError as error:
        raise KgcpError(f"{path}: {error}") from None


def _chosen(
    file: ForeignFile, entries: Sequence[Entry], camera: str | None, words: ErrorWords
) -> Entry:
    """Return the camera of that name, or the only one."""
    if not entries:
        raise file.error("holds no camera", "export the calibration again")
    names = list(dict.fromkeys(entry.name for entry in entries))
    if camera is None:
        if len(entries) == 1:
            return entries[0]
        raise file.error(
            f"holds the cameras {listed([*map(repr, names)], _MAX_NAMED)}", words.several_cameras
        )
    chosen = [entry for entry in entries if entry.name == camera]
    if len(chosen) != 1:
        count = "several cameras" if chosen else "no camera"
        raise file.error(
            f"holds {count} {camera!r}, but {listed([*map(repr, names)], _MAX_NAMED)}",
            "correct [camera] camera",
        )
    return chosen[0]


def _agreed_size(
    file: ForeignFile, entry: Entry, stated: tuple[int | None, int | None], words: ErrorWords
) -> tuple[int, int]:
    width, height = stated
    if entry.size is None:
        if width is None or height is None:
            raise file.error("has no image size", words.no_size)
        return width, height
    found_width, found_height = entry.size
    if min(entry.size) < 1:
        raise file.error(f"is for {found_width} x {found_height} px")
    size = (width or found_width, height or found_height)
    if size != entry.size and not (entry.is_relative and _same_shape(size, entry.size)):
        raise file.error(
            f"is for {found_width} x {found_height} px, {words.other_size} {size[0]} x {size[1]}",
            "use the calibration of this frame size",
        )
    return size


def _same_shape(size: tuple[int, int], file_size: tuple[int, int]) -> bool:
    """Whether one size is the other resized, its shorter side rounded to whole pixels."""
    scale = max(size) / max(file_size)
    return (size[0] < size[1]) == (file_size[0] < file_size[1]) and abs(
        min(size) - min(file_size) * scale
    ) <= max(scale, 1.0)
