"""Tables of surveyed points: a name and coordinates in every row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp.io.files.csv_columns import read_csv_columns
from kgcp.io.files.csv_sniff import SniffedTable, sniff_table
from kgcp.io.files.sniff import ForeignFile

_XYZ = ("x", "y", "z")
_COLUMNS: Mapping[str, Sequence[str]] = {
    "name": (
        *("name", "id", "point", "pointname", "pointid", "label", "target", "punkt", "punktnummer"),
        *("pktnr", "nr"),
    ),
    "x": ("x", "e", "east", "easting", "ostwert", "rechtswert", "longitude", "lon", "long"),
    "y": ("y", "n", "north", "northing", "nordwert", "hochwert", "latitude", "lat"),
    "z": (
        *("z", "h", "u", "height", "alt", "altitude", "elevation", "up"),
        *("hoehe", "höhe", "ellheight"),
    ),
}


@dataclass(frozen=True, slots=True)
class PointTable:
    """A file of surveyed points."""

    path: Path
    table: SniffedTable

    @property
    def first_xy(self) -> tuple[float, float] | None:
        """The place of the first point; None if these are not numbers."""
        x, y = self.table.number("x"), self.table.number("y")
        return None if x is None or y is None else (x, y)

    def positions(self) -> dict[str, tuple[float, float, float]]:
        """Return x, y, z of all points by name, the first of each name.

        Raises
        ------
        KgcpError
            Naming the line of a cell that is not a number.
        """
        columns = read_csv_columns(self.path, ("name",), _XYZ, (), "", self.table.layout)
        places: dict[str, tuple[float, float, float]] = {}
        for name, row in zip(columns.texts["name"], columns.block(_XYZ).tolist(), strict=True):
            places.setdefault(name, (row[0], row[1], row[2]))
        return places


def recognised_points(file: ForeignFile) -> PointTable | None:
    """Return a file as a table of points; None if it lacks names or coordinates."""
    table = sniff_table(file, _COLUMNS)
    if table is None or table.cells.keys() != _COLUMNS.keys():
        return None
    return PointTable(file.path, table)
