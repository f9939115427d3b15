"""Writers of KGCPs, one module per receiving package.

A module offers `files(points: MapPoints) -> Mapping[str, str]`, file names and their text, and has
one line in `FORMATS`; it is imported when its format is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kgcp.io.exporters.points import MapPoints

FORMATS: Mapping[str, str] = {
    "csv": "kgcp.io.exporters.plain_csv",
    "odm": "kgcp.io.exporters.odm",
}
"""Name on the command line → module."""


def export(points: MapPoints, name: str, folder: Path) -> list[Path]:
    """Write the files of one format; return their paths.

    Raises
    ------
    KgcpError
        If the format cannot hold these points, or a file cannot be written.
    """
    from kgcp.io.wholefile import write_bytes

    files: Mapping[str, str] = import_module(FORMATS[name]).files(points)
    for file_name, text in files.items():
        write_bytes(folder / file_name, text.encode("utf-8"))
    return [folder / file_name for file_name in files]
