"""Image positions of targets, marked by hand."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.georef.plain_prediction import MarkedPlace
from kgcp.io.files.csv_columns import frame_name, read_csv_columns
from kgcp.io.files.safe_read import is_file

_TEXTS, _NUMBERS, _SD = ("frame", "target"), ("x_px", "y_px"), "sd_px"
_DEFAULT_SD_PX = 2.0  # of marks by hand
_MIN_SD_PX = 0.001  # its square, and quotients by that, remain ordinary numbers


@dataclass(frozen=True, slots=True)
class HandMark:
    """One target marked in one frame."""

    target: str
    place: MarkedPlace


def read_marks(
    path: Path, frames: Collection[str], targets: Collection[str], camera: Camera
) -> Mapping[str, tuple[HandMark, ...]]:
    """Read marks, CSV with the columns frame, target, x_px, y_px and perhaps sd_px, by frame.

    Parameters
    ----------
    frames, targets : collection of str
        Names that may stand in the file.

    Raises
    ------
    KgcpError
        If the file is missing or marks nothing; a cell is wrong, or names no frame or target of
        this flight; a target is marked twice in a frame, or outside it; or a frame does not have
        two marks, whose distance gives its scale, or has two at one place. The message names the
        line.
    """
    if not is_file(path):
        raise KgcpError(f"{path}: does not exist; name a file of marked places", option="places")
    table = read_csv_columns(path, _TEXTS, _NUMBERS, (_SD,), "places")
    places = table.block(_NUMBERS).tolist()
    sds = (
        table.block((_SD,))[:, 0].tolist() if _SD in table.names else [_DEFAULT_SD_PX] * len(places)
    )
    marks: dict[str, dict[str, HandMark]] = {}
    rows = zip(table.lines, *(table.texts[name] for name in _TEXTS), places, sds, strict=True)
    for line, text, target, (x_px, y_px), sd_px in rows:
        frame, where = frame_name(text), f"{path}, line {line}"
        if frame not in frames:
            problem = f"{text!r} is not a frame; write its path below the frames folder"
            raise KgcpError(f"{where}: {problem}")
        if target not in targets:
            listed = ", ".join(sorted(targets))
            raise KgcpError(f"{where}: {target!r} is not a static target; name one of {listed}")
        if not (0.0 <= x_px <= camera.width - 1.0 and 0.0 <= y_px <= camera.height - 1.0):
            raise KgcpError(f"{where}: ({x_px:g}, {y_px:g}) is outside the frame; correct it")
        if sd_px < _MIN_SD_PX:
            problem = f"sd_px is {sd_px:g}; give a standard deviation of {_MIN_SD_PX:g} or more"
            raise KgcpError(f"{where}: {problem}")
        if target in marks.setdefault(frame, {}):
            raise KgcpError(f"{where}: {target!r} is marked twice in {frame}; keep one of them")
        marks[frame][target] = HandMark(target, MarkedPlace(x_px, y_px, sd_px))
    _require_scale(path, marks)
    return {frame: tuple(named.values()) for frame, named in marks.items()}


def _require_scale(path: Path, marks: Mapping[str, Mapping[str, HandMark]]) -> None:
    """Refuse frames whose marks do not give their scale."""
    if not marks:
        raise KgcpError(f"{path}: marks no target; mark two static targets or more in a frame")
    for frame, named in marks.items():
        positions = {(mark.place.x_px, mark.place.y_px) for mark in named.values()}
        if len(positions) < max(2, len(named)):
            problem = "has one mark" if len(named) < 2 else "has two marks at one place"
            raise KgcpError(
                f"{path}: {frame} {problem}; mark two static targets or more in a frame"
            )
