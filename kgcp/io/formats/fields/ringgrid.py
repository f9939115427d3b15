"""ringgrid's target.json: rings on a hexagonal or square lattice, plain or with sectors as codes.

Schemas v4 and v5. Lengths are millimetres. The pitch of its hexagonal lattices is the radius of the
hexagons around the rings: neighbours are √3 times the pitch apart. The rings are named by their
place in the lattice; codes and the dots beside the origin are not read.
"""

from __future__ import annotations

import math

from kgcp.io.files.sniff import ForeignFile, NamedValues
from kgcp.targets.fields.layout import Field, GridKind, Mark

_SCHEMAS = ("ringgrid.target.v4", "ringgrid.target.v5")
_MM = 0.001
_MAX_COUNT = 1000  # of rows, and of rings in a row


def matches(file: ForeignFile) -> bool:
    """Whether the content is JSON that names one of ringgrid's schemas."""
    document = file.document
    if not isinstance(document, dict):
        return False
    return str(document.get("schema", "")).startswith("ringgrid.target.")


def field(file: ForeignFile, unit_m: float | None) -> Field:  # noqa: ARG001 - as all readers
    """Return the board."""
    board = NamedValues.of(file, "", file.document)
    schema = board.text("schema")
    if schema not in _SCHEMAS:
        raise file.error(f"has schema {schema[:40]!r}", f"export it as {_SCHEMAS[-1]}")
    is_flat = schema == _SCHEMAS[0]
    lattice = board if is_flat else board.child("lattice")
    marker = board if is_flat else board.child("marker")
    coding = board if is_flat else board.child("coding")
    prefix = "marker_" if is_flat else ""
    outer_mm = marker.number(f"{prefix}outer_radius_mm")
    inner_mm = marker.number(f"{prefix}inner_radius_mm")
    if is_flat or coding.text("kind") != "plain":
        # two rings drawn about these radii, with the code between them; the outer one is measured
        width_mm = coding.number(f"{prefix}ring_width_mm")
        outer_mm, inner_mm = outer_mm + 0.5 * width_mm, outer_mm - 0.5 * width_mm
    sizes_m = (2.0 * _MM * outer_mm, 2.0 * _MM * inner_mm)
    name, pitch_m = board.text("name")[:100], _MM * lattice.number("pitch_mm")
    if not name.strip() or not name.isprintable():
        name = file.path.stem  # a field.toml cannot hold such a name
    rows = _count(lattice, "rows")
    kind = "hex" if is_flat else lattice.text("kind")
    if kind == "rect":
        columns = _count(lattice, "cols")
        return Field(name, GridKind.SQUARE, columns, rows, pitch_m, sizes_m[0], sizes_m[1])
    if kind != "hex":
        raise lattice.error(f"has a lattice of kind {kind[:40]!r}", "print one of hex, rect")
    longest = _count(lattice, "long_row_cols")
    columns, marks = _hexagonal(rows, longest, sizes_m[0])
    return Field(
        name,
        GridKind.HEXAGONAL,
        columns,
        rows,
        math.sqrt(3.0) * pitch_m,
        sizes_m[0],
        sizes_m[1],
        marks=marks,
    )


def _hexagonal(rows: int, longest: int, diameter_m: float) -> tuple[int, tuple[Mark, ...]]:
    """Return the number of columns in kgcp's sense, and the places that are empty.

    Rows alternately have `longest` rings and one less, by ringgrid's rule counted from the middle
    row. kgcp counts half-steps from the last row, which begins at the first. If the last row is a
    short one, the board is described as one that is a step wider, in which both ends of every short
    row are missing.
    """

    def is_long(row: int) -> bool:
        return (row - rows // 2 + longest - 1) % 2 == 0

    if is_long(rows - 1):
        return 2 * longest - 1, ()
    short = [row for row in range(rows) if not is_long(row)]
    missing = [Mark(end, row, diameter_m, is_missing=True) for row in short for end in (0, longest)]
    return 2 * longest + 1, tuple(missing)


def _count(lattice: NamedValues, key: str) -> int:
    count = lattice.number(key)
    if count != int(count) or not 2 <= count <= _MAX_COUNT:
        raise lattice.error(f"{key!r} is {count:g}", f"print a board with 2 to {_MAX_COUNT}")
    return int(count)
