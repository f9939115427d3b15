"""Readers of the camera's reference poses, one module per format.

Each module has one line in `FORMATS` and offers two functions. `matches(file)` says whether the
content has its format, `poses(file)` returns its poses. `poses` raises `KgcpError`, which names the
line or element, if a file does not follow its format.
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
        The flight's, in which the poses are returned. It may be None if the file's coordinates are
        the flight's.
    frames : sequence of str
        Of the flight: other programs may only have their file names.

    Raises
    ------
    KgcpError
        If the file is missing, of no known format, incomplete, not georeferenced, or in a CRS that
        cannot be transformed to the flight's. The message names file, element and remedy.
    """
    options = options or OrientationFileOptions()
    file = ForeignFile(path, "[reference] poses")
    source = FORMATS.reader(file, options.form)(file)
    if not source.names:
        raise file.error("holds no pose", "export the aligned frames")
    names = source.names if source.has_our_names else frames_of(file, source.names, frames)
    return on_the_map(file, source, names, options, crs)
