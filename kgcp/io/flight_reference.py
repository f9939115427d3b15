"""The [reference] table of flight.toml."""

from __future__ import annotations

from pathlib import Path

from kgcp.io.poses.notation import PoseNotation
from kgcp.io.toml_values import TomlTable

REFERENCE_KEYS = ("poses", "format", "crs", "offset")


def read_reference(flight: TomlTable, folder: Path) -> tuple[Path | None, PoseNotation]:
    """Return the file of the reference poses, if there is one, and how to understand it.

    It is not looked for until a command needs it.

    Raises
    ------
    KgcpError
        If a key is unknown, missing or of the wrong type.
    """
    from kgcp.io.poses import FORMATS

    if "reference" not in flight:
        return None, PoseNotation()
    table = flight.table("reference", REFERENCE_KEYS)
    notation = PoseNotation(
        form=table.choice("format", tuple(FORMATS)) if "format" in table else None,
        crs=table.text("crs") if "crs" in table else None,
        offset_file=table.existing_file("offset", folder) if "offset" in table else None,
    )
    return folder / table.text("poses"), notation
