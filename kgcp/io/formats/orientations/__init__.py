"""Readers of the camera's reference poses, one module per format.

A module offers `matches(file)`, whether a file's content is of its format, and `poses(file)`, what
stands in it, and has one line in `FORMATS`. `poses` raises `KgcpError`, which names the line or
element, for a file that is not as its format says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from kgcp.geometry.attitude import ReferencePoses
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.frame_names import frames_of
from kgcp.io.formats.orientations import colmap, csv, metashape, odm, opensfm, opf, pix4d
from kgcp.io.formats.orientations.georeference import on_the_map
from kgcp.io.formats.orientations.records import OrientationFileOptions, SourcePoses
from kgcp.io.formats.registry import Registry

FORMATS: Registry[Callable[[ForeignFile], SourcePoses]] = Registry(
    "a file of reference poses",
    "convert it to the columns of docs/foreign_files.md",
    {
        "opf": (opf.matches, opf.poses),
        "opensfm": (opensfm.matches, opensfm.poses),
        "odm": (odm.matches, odm.poses),
        "metashape": (metashape.matches, metashape.poses),
        "pix4d": (pix4d.matches, pix4d.poses),
        "csv": (csv.matches, csv.poses),
        "colmap": (colmap.matches, colmap.poses),
    },
)


def read_reference_poses(
    path: Path,
    options: OrientationFileOptions | None = None,
    *,
    crs: str | None = None,
    frames: Sequence[str] = (),
) -> ReferencePoses:
    """Read reference poses in one of the `FORMATS`; docs/foreign_files.md has their conversions.

    Parameters
    ----------
    options : OrientationFileOptions or None
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
        incomplete, not georeferenced, or in a CRS from which no way leads to the flight's.
    """
    options = options or OrientationFileOptions()
    file = ForeignFile(path, "[reference] poses")
    source = FORMATS.reader(file, options.form)(file)
    if not source.names:
        raise file.error("holds no pose", "export the aligned frames")
    names = source.names if source.has_our_names else frames_of(file, source.names, frames)
    return on_the_map(file, source, names, options, crs)
