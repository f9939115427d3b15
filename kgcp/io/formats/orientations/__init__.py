"""Readers of the camera's reference poses, one module per format.

A module offers `matches(file)`, whether a file's content is of its format, and `poses(file)`, what
stands in it, and has one line in `PoseFormat` and in `_READERS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType

from kgcp.geometry.attitude import ReferencePoses
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations import colmap, csv, metashape, odm, opensfm, opf, pix4d
from kgcp.io.formats.orientations.georeference import on_the_map
from kgcp.io.formats.orientations.names import frames_of
from kgcp.io.formats.orientations.notation import PoseFormat, PoseNotation
from kgcp.io.formats.orientations.source import SourcePoses

_READERS: Mapping[PoseFormat, ModuleType] = {
    PoseFormat.OPF: opf,
    PoseFormat.OPENSFM: opensfm,
    PoseFormat.ODM: odm,
    PoseFormat.METASHAPE: metashape,
    PoseFormat.PIX4D: pix4d,
    PoseFormat.CSV: csv,
    PoseFormat.COLMAP: colmap,
}


def read_reference_poses(
    path: Path,
    notation: PoseNotation | None = None,
    *,
    crs: str | None = None,
    frames: Sequence[str] = (),
) -> ReferencePoses:
    """Read reference poses, in any `PoseFormat`; docs/conventions.md has their conversions.

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
    notation = notation or PoseNotation()
    file = ForeignFile.read(path, "[reference] poses")
    source: SourcePoses = _READERS[notation.form or _recognised(file)].poses(file)
    if not source.names:
        raise file.error("", "holds no pose", "export the aligned frames")
    names = source.names
    if not source.has_our_names:
        names = frames_of(file, names, frames)
    return on_the_map(file, source, names, notation, crs)


def _recognised(file: ForeignFile) -> PoseFormat:
    for form, reader in _READERS.items():
        if reader.matches(file):
            return form
    raise file.error(
        "",
        f"holds no reference poses of a known format ({', '.join(sorted(PoseFormat))})",
        "convert it to the columns of docs/conventions.md",
    )
