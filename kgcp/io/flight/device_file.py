"""device.toml: the points of an EO device."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError, SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.flight.toml_file import read_toml
from kgcp.io.flight.toml_table import TomlTable
from kgcp.network.ground.device import require_distinct

DEVICE_KEYS = ("name", "point")
DEVICE_POINT_KEYS = ("name", "position_m")


@dataclass(frozen=True, slots=True, eq=False)
class EoDevice:
    """An EO device."""

    name: str
    points_m: FloatArray  # (n, 3): in the device's own frame


def read_device(path: Path) -> EoDevice:
    """Read an EO device.

    Raises
    ------
    KgcpError
        Naming file, key and remedy: if the file is missing, not TOML, has unknown keys, the same
        name twice, or points that can be exchanged.
    """
    table, _ = read_toml(path, DEVICE_KEYS, "the device")
    points = [
        TomlTable(f"{table.where} [[point]]", values, DEVICE_POINT_KEYS)
        for values in table.tables("point")
    ]
    names = tuple(point.name("name") for point in points)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise table.error("point", f"has the name {twice[0]!r} twice", "name each point once")
    positions = np.array([point.vector("position_m") for point in points])
    try:
        require_distinct(positions)
    except SettingError as error:
        raise KgcpError(f"{path}: {error}") from None
    return EoDevice(table.optional("name", table.name) or path.stem, positions)
