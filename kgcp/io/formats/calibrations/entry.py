"""Result of a reader of calibrations: the cameras of a file, not yet converted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera
from kgcp.io.files.sniff import ForeignFile

CORNER_TO_CENTRE_PX = -0.5
"""From pixels that count from the corner of the top-left one to those from its centre."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One camera of a file."""

    name: str  # what `[camera] camera` calls it
    size: tuple[int, int] | None  # width and height [px] that the file gives; None: it does not
    # makes the `Camera` for a width and height [px], or raises `KgcpError` where the model cannot
    # be represented exactly
    convert: Callable[[int, int], Camera]
    # whether the parameters are relative to the frame's size, so that they hold for any size of the
    # same shape
    is_relative: bool = False


def unsupported(file: ForeignFile, term: str, where: str = "") -> KgcpError:
    """Return the error for a model, or a term of it, that `Camera` cannot represent."""
    return file.error_at(
        where,
        f"has {term}, which kgcp does not support",
        "calibrate with OpenCV's k1 k2 p1 p2 k3 or rational model",
    )


def refuse_terms(
    file: ForeignFile, where: str, names: Sequence[str], values: Sequence[float]
) -> None:
    """Raise `KgcpError` for the first of these terms that is not zero."""
    for name, value in zip(names, values, strict=True):
        if value != 0.0:
            raise unsupported(file, f"{name} = {value:g}", where)
