"""Where results go: nowhere but to their folder, whatever a flight's folder holds."""

from __future__ import annotations

import os
from pathlib import Path

from kgcp.errors import KgcpError

NAME = "kgcp"
"""Of the results' folder in that of the flight."""


def results_folder(flight: Path) -> Path:
    """Return the results' folder of a flight for which no other is named.

    A flight's folder may come from anybody. A link in the place of its results, or of a folder
    among them, would have files written wherever it leads.

    Raises
    ------
    KgcpError
        If there is such a link.
    """
    folder = flight / NAME
    if folder.is_symlink():
        raise KgcpError(f"{folder}: is a link; delete it, or name where it leads with --out")
    for parent, folders, _ in os.walk(folder):
        for name in folders:
            path = Path(parent) / name
            if path.is_symlink():
                raise KgcpError(
                    f"{path}: is a link to a folder; delete it, or choose another --out"
                )
    return folder
