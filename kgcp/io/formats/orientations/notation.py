"""What flight.toml says about how a file of reference poses is to be understood."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class PoseNotation:
    """The keys of [reference] about its file.

    Attributes
    ----------
    form : str or None
        One of `kgcp.io.formats.orientations.FORMATS`; None: the content tells.
    crs : str or None
        Of the file's coordinates, for pyproj, where the file does not say it; None: the flight's,
        or as the format has it.
    offset_file : Path or None
        Holds what was subtracted from the file's coordinates; None: nothing was.
    """

    form: str | None = None
    crs: str | None = None
    offset_file: Path | None = None
