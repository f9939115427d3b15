"""Tables of surveyed points: a name and coordinates in every row."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.csv_columns import CsvColumns, read_csv_columns
from kgcp.io.files.csv_sniff import SniffedTable, sniff_table
from kgcp.io.files.sniff import ForeignFile

_XYZ = ("x", "y", "z")
_COLUMNS: Mapping[str, Sequence[str]] = {
    "name": (
        *("name", "id", "point", "pointname", "pointid", "label", "target", "punkt", "punktnummer"),
        *("pktnr", "nr", "p", "pt", "pkt"),
    ),
    "x": ("x", "e", "east", "easting", "ostwert", "rechtswert", "longitude", "lon", "long"),
    "y": ("y", "n", "north", "northing", "nordwert", "hochwert", "latitude", "lat"),
    "z": (
        *("z", "h", "u", "height", "alt", "altitude", "elevation", "up"),
        *("hoehe", "höhe", "ellheight"),
    ),
}


@dataclass(frozen=True, eq=False)
class PointTable:
    """A file of surveyed points."""

    path: Path
    table: SniffedTable

    @property
    def first_xy(self) -> tuple[float, float] | None:
        """The place of the first point; None if these are not numbers."""
        x, y = self.table.number("x"), self.table.number("y")
        return None if x is None or y is None else (x, y)

    @property
    def is_geographic(self) -> bool:
        """Whether x, y are longitude and latitude [deg] by their names."""
        return self.table.name_of("x").lower().startswith("lon")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all points, in their order.

        Raises
        ------
        KgcpError
            If the file cannot be read.
        """
        return self._columns.texts["name"]

    def positions(self, names: Collection[str]) -> dict[str, tuple[float, float, float]]:
        """Return x, y, z of the points with these names.

        Raises
        ------
        KgcpError
            Naming the line of a cell that is not a number, or a point with several places.
        """
        columns = self._columns
        places: dict[str, tuple[float, float, float]] = {}
        for name, row in zip(columns.texts["name"], columns.block(_XYZ).tolist(), strict=True):
            if name in names:
                place = (row[0], row[1], row[2])
                require_one_place(name, places.setdefault(name, place), place, str(self.path))
        return places

    @cached_property
    def _columns(self) -> CsvColumns:
        return read_csv_columns(self.path, ("name",), _XYZ, (), "", self.table.layout)


def require_one_place(
    name: str, first: tuple[float, float, float], other: tuple[float, float, float], where: str
) -> None:
    """Refuse a point that has two places.

    Raises
    ------
    KgcpError
        If the places differ.
    """
    if first != other:
        raise KgcpError(
            f"{where}: the point {name!r} has two places: {_text(first)} and {_text(other)}; keep"
            " the right one"
        )


def _text(place: tuple[float, float, float]) -> str:
    return ", ".join(f"{value:.10g}" for value in place)


def recognised_points(file: ForeignFile) -> PointTable | None:
    """Return a file as a table of points; None if it lacks names or coordinates."""
    table = sniff_table(file, _COLUMNS)
    if table is None or table.cells.keys() != _COLUMNS.keys():
        return None
    return PointTable(file.path, table)
