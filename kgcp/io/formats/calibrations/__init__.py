"""Camera calibrations as other programs write them, one module per format.

A module offers `matches(file)`, whether a file's content is of its format, and `entries(file)`,
the cameras in it, and has one line in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry

FORMATS: Mapping[str, str] = {
    "opf": "kgcp.io.formats.calibrations.opf",
    "opensfm": "kgcp.io.formats.calibrations.opensfm",
    "metashape": "kgcp.io.formats.calibrations.metashape",
    "dji": "kgcp.io.formats.calibrations.dji",
    "pix4d": "kgcp.io.formats.calibrations.pix4d",
    "colmap": "kgcp.io.formats.calibrations.colmap",
    "opencv": "kgcp.io.formats.calibrations.opencv",
    "ros": "kgcp.io.formats.calibrations.ros",
}
"""Name in flight.toml → module, in the order in which they are tried."""


def read_calibration(
    path: Path,
    stated_size: tuple[int | None, int | None],
    form: str | None = None,
    camera: str | None = None,
) -> Camera:
    """Read a calibration file.

    Parameters
    ----------
    path : Path
        A file of one of the `FORMATS`; docs/conventions.md has their conversions.
    stated_size : tuple of int or None
        Width and height [px] that flight.toml gives beside the file: needed where the file is
        silent, else they must agree.
    form : str or None
        One of `FORMATS`; None: the content tells.
    camera : str or None
        Name of the camera where the file has several.

    Raises
    ------
    KgcpError
        If the file is missing, is of no known format, lacks the size or the camera, or holds a
        model that `Camera` cannot represent exactly; it names the term.
    """
    file = ForeignFile.read(path, "[camera] file")
    entries = _module(file, form).entries(file)
    entry = _chosen(file, entries, camera)
    width, height = _agreed_size(file, entry, stated_size)
    try:
        return entry.convert(width, height)
    except SettingError as error:
        raise KgcpError(f"{path}: {error}") from None


def _module(file: ForeignFile, form: str | None) -> ModuleType:
    if form is not None:
        return import_module(FORMATS[form])
    for name in FORMATS.values():
        module = import_module(name)
        if module.matches(file):
            return module
    raise file.error(
        "",
        f"is no calibration of a known format ({', '.join(sorted(FORMATS))})",
        "convert it or write the values to [camera]",
    )


def _chosen(file: ForeignFile, entries: Sequence[Entry], camera: str | None) -> Entry:
    """Return the camera of that name, or the only one."""
    if not entries:
        raise file.error("", "holds no camera", "export the calibration again")
    names = list(dict.fromkeys(entry.name for entry in entries))
    if camera is None:
        if len(entries) == 1:
            return entries[0]
        raise file.error(
            "", f"holds the cameras {_listed(names)}", "choose one with [camera] camera"
        )
    chosen = [entry for entry in entries if entry.name == camera]
    if len(chosen) != 1:
        count = "several cameras" if chosen else "no camera"
        raise file.error(
            "", f"holds {count} {camera!r}, but {_listed(names)}", "correct [camera] camera"
        )
    return chosen[0]


def _listed(names: Sequence[str], most: int = 8) -> str:
    shown = ", ".join(repr(name) for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def _agreed_size(
    file: ForeignFile, entry: Entry, stated: tuple[int | None, int | None]
) -> tuple[int, int]:
    width, height = stated
    if entry.size is None:
        if width is None or height is None:
            raise file.error("", "has no image size", "add width and height to [camera]")
        return width, height
    found_width, found_height = entry.size
    if min(entry.size) < 1:
        raise file.error("", f"is for {found_width} x {found_height} px", "export it again")
    size = (width or found_width, height or found_height)
    if size != entry.size and not (entry.is_relative and _same_shape(size, entry.size)):
        raise file.error(
            "",
            f"is for {found_width} x {found_height} px, but [camera] says {size[0]} x {size[1]}",
            "use the calibration of this frame size",
        )
    return size


def _same_shape(size: tuple[int, int], found: tuple[int, int]) -> bool:
    """Whether one size is the other resized, its shorter side rounded to whole pixels."""
    scale = max(size) / max(found)
    return (size[0] < size[1]) == (found[0] < found[1]) and abs(
        min(size) - min(found) * scale
    ) <= max(scale, 1.0)
