"""Boards of other programs, one module per format.

Each module has one line in `FORMATS` and offers two functions. `matches(file)` says whether the
content has its format, `field(file, unit_m)` returns its board. `unit_m` is needed if the format
does not state the unit (`WITHOUT_UNIT`), and None for the others.
"""

from __future__ import annotations

from collections.abc import Callable

from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.fields import boofcv, dice, nxyz, ringgrid, ros_industrial
from kgcp.io.formats.registry import Registry
from kgcp.targets.fields.points import AnyField

FORMATS: Registry[Callable[[ForeignFile, float | None], AnyField]] = Registry(
    "a field of targets",
    "describe it in a field.toml",
    {
        "boofcv": (boofcv.matches, boofcv.field),
        "dice": (dice.matches, dice.field),
        "ringgrid": (ringgrid.matches, ringgrid.field),
        "ros_industrial": (ros_industrial.matches, ros_industrial.field),
        "nxyz": (nxyz.matches, nxyz.field),
    },
)

WITHOUT_UNIT = frozenset({"boofcv", "nxyz"})
"""Names of the formats that do not state what unit their lengths are in."""
