"""Readers of the camera's reference poses, one module per format.

A module offers `matches(file)`, whether a file's content is of its format, and `poses(file)`, what
stands in it, and has one line in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from kgcp.geometry.attitude import ReferencePoses
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.names import frames_of
from kgcp.io.formats.orientations.notation import PoseNotation

if TYPE_CHECKING:
    from kgcp.io.flight.flight import Flight
    from kgcp.io.formats.orientations.source import SourcePoses

FORMATS: Mapping[str, str] = {
    "opf": "kgcp.io.formats.orientations.opf",
    "opensfm": "kgcp.io.formats.orientations.opensfm",
    "odm": "kgcp.io.formats.orientations.odm",
    "metashape": "kgcp.io.formats.orientations.metashape",
    "pix4d": "kgcp.io.formats.orientations.pix4d",
    "csv": "kgcp.io.formats.orientations.csv",
    "colmap": "kgcp.io.formats.orientations.colmap",
}
"""Name in flight.toml → module, in the order in which they are tried."""


def read_flight_poses(flight: Flight, frames: Sequence[str] | None = None) -> ReferencePoses | None:
    """Read the reference poses of a flight, in its CRS; None where flight.toml names none.

    Parameters
    ----------
    flight : Flight
    frames : sequence of str or None
        Its frames, by which the file's images are known; None: those in the frames folder.

    Raises
    ------
    KgcpError
        As `read_reference_poses`.
    """
    if flight.reference_file is None:
        return None
    from kgcp.io.images.frames import list_frames

    return read_reference_poses(
        flight.reference_file,
        flight.reference_notation,
        crs=flight.crs,
        frames=list_frames(flight.frames_folder) if frames is None else frames,
    )


def read_reference_poses(
    path: Path,
    notation: PoseNotation | None = None,
    *,
    crs: str | None = None,
    frames: Sequence[str] = (),
) -> ReferencePoses:
    """Read reference poses, of any of the `FORMATS`; docs/conventions.md has their conversions.

    Parameters
    ----------
    path : Path
        The file.
    notation : PoseNotation or None
        What flight.toml says about the file; None: nothing.
    crs : str or None
        The flight's, in which the poses are returned; it may be None where the file's coordinates
        are the flight's.
    frames : sequence of str
        Of the flight: other programs know them by their file names alone.

    Raises
    ------
    KgcpError
        Naming the file, the element in it and the remedy: if it is missing, of no known format,
        incomplete, georeferenced by nothing, or in a CRS from which no way leads to the flight's.
    """
    from kgcp.io.formats.orientations.georeference import on_the_map

    notation = notation or PoseNotation()
    file = ForeignFile.read(path, "[reference] poses")
    module = import_module(FORMATS[notation.form or _recognised(file)])
    source: SourcePoses = module.poses(file)
    if not source.names:
        raise file.error("", "holds no pose", "export the aligned frames")
    names = source.names
    if not source.has_our_names:
        names = frames_of(file, names, frames)
    return on_the_map(file, source, names, notation, crs)


def _recognised(file: ForeignFile) -> str:
    for name, module in FORMATS.items():
        if import_module(module).matches(file):
            return name
    raise file.error(
        "",
        f"holds no reference poses of a known format ({', '.join(sorted(FORMATS))})",
        "convert it to the columns of docs/conventions.md",
    )
