"""What flight.toml says about how a file of reference poses is to be understood."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class PoseFormat(StrEnum):
    """A format of reference poses, by its name in flight.toml, in the order they are tried in."""

    OPF = "opf"
    OPENSFM = "opensfm"
    ODM = "odm"
    METASHAPE = "metashape"
    PIX4D = "pix4d"
    CSV = "csv"
    COLMAP = "colmap"


@dataclass(frozen=True, slots=True)
class PoseNotation:
    """The keys of [reference] about its file.

    Attributes
    ----------
    form : PoseFormat or None
        None: the content tells.
    crs : str or None
        Of the file's coordinates, for pyproj, where the file does not say it; None: the flight's,
        or as the format has it.
    offset_file : Path or None
        Holds what was subtracted from the file's coordinates; None: nothing was.
    """

    form: PoseFormat | None = None
    crs: str | None = None
    offset_file: Path | None = None
