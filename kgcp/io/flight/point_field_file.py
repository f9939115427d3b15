"""Fields of points in field.toml: in a CSV file that it names, or one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.csv_columns import CsvColumns, read_csv_columns
from kgcp.io.flight.toml_draft import toml_text
from kgcp.io.flight.toml_table import TomlTable
from kgcp.targets.fields.layout import FieldBar, FieldPolarity
from kgcp.targets.fields.points import CodeRing, FieldPoint, PointField

POINT_KEYS = ("points", "point", "code")
_FILE_KEYS = ("file",)
_CODE_KEYS = ("kind", "bits", "ring")
_ONE_KEYS = (*("name", "position_m", "sd_m", "diameter_m", "inner_diameter_m", "normal", "code"),)
_PLACE = ("x", "y", "z")
_SDS = ("sd_x", "sd_y", "sd_z")
_NORMAL = ("normal_x", "normal_y", "normal_z")
_OTHERS = ("diameter_m", "inner_diameter_m", "code")
_UPRIGHT = (0.0, 0.0, 1.0)


def point_field(
    table: TomlTable,
    folder: Path,
    name: str,
    polarity: FieldPolarity,
    bars: tuple[FieldBar, ...],
) -> PointField:
    """Return the field that `[points]` or `[[point]]` describe.

    Parameters
    ----------
    table : TomlTable
        The whole file.
    folder : Path
        Where it lies.

    Raises
    ------
    KgcpError
        Naming file, key or line, and remedy.
    """
    if "points" in table and "point" in table:
        raise table.error("point", "is given beside [points]", "give one of them")
    ring = _code_ring(table) if "code" in table else None
    inner_m = table.number("inner_diameter_m", 0.0)
    diameter_m = table.optional("diameter_m", table.number)
    if "points" in table:
        points = _from_file(table, folder, diameter_m, inner_m)
    else:
        rows = enumerate(table.tables("point"), start=1)
        points = tuple(
            _from_table(_point_table(table, number, row), diameter_m, inner_m)
            for number, row in rows
        )
    with table.located():
        made = PointField(name, points, polarity, bars=bars, code=ring)
        return replace(made, flat_sd_m=table.vector("flat_sd_m", made.flat_sd_m))


def points_file(table: TomlTable, folder: Path) -> Path:
    """Return the file of the discs that `[points]` names."""
    return table.table("points", _FILE_KEYS).existing_file("file", folder)


def _code_ring(table: TomlTable) -> CodeRing:
    code = table.table("code", _CODE_KEYS)
    code.choice("kind", ("ring",))
    ring = code.numbers("ring", "[2.1, 3.1]")
    if len(ring) != 2:
        raise code.error("ring", f"has {len(ring)} numbers instead of 2", "give it as [2.1, 3.1]")
    with code.located():
        return CodeRing(code.integer("bits"), ring[0], ring[1])


def _point_table(whole: TomlTable, number: int, values: Mapping[str, object]) -> TomlTable:
    """Return a [[point]] table, called by its name or, failing that, by its place."""
    name = values.get("name")
    called = name if isinstance(name, str) else number
    return TomlTable(f"{whole.where} [[point]] {called}", values, _ONE_KEYS)


def _from_table(table: TomlTable, diameter_m: float | None, inner_m: float) -> FieldPoint:
    return FieldPoint(
        table.name("name"),
        table.vector("position_m"),
        table.number("diameter_m", diameter_m),
        table.number("inner_diameter_m", inner_m),
        table.vector("normal", _UPRIGHT, "[0, 0, 1]"),
        table.optional("sd_m", table.vector),
        table.optional("code", table.integer),
    )


def _from_file(
    table: TomlTable, folder: Path, diameter_m: float | None, inner_m: float
) -> tuple[FieldPoint, ...]:
    path = points_file(table, folder)
    columns = read_csv_columns(
        path, ("name",), _PLACE, (*_SDS, *_NORMAL, *_OTHERS), "[points] file"
    )
    if diameter_m is None and "diameter_m" not in columns.names:
        raise KgcpError(
            f"{path}, line 1: has no column diameter_m, and {table.where} no diameter_m either;"
            " give one of them"
        )
    for group in (_SDS, _NORMAL):
        absent = [name for name in group if name not in columns.names]
        if 0 < len(absent) < len(group):
            raise KgcpError(
                f"{path}, line 1: lacks {', '.join(absent)}; give all of"
                f" {', '.join(group)}, or none"
            )
    rows = range(len(columns.lines))
    return tuple(_from_row(columns, row, diameter_m or 0.0, inner_m) for row in rows)


def _from_row(columns: CsvColumns, row: int, diameter_m: float, inner_m: float) -> FieldPoint:
    def cell(name: str, default: float) -> float:
        if name not in columns.names:
            return default
        return float(columns.numbers[row, columns.names.index(name)])

    def three(names: tuple[str, str, str]) -> tuple[float, float, float]:
        first, second, third = names
        return cell(first, 0.0), cell(second, 0.0), cell(third, 0.0)

    where, name = f"{columns.path}, line {columns.lines[row]}", columns.texts["name"][row]
    if not name or not name.isprintable():
        raise KgcpError(f"{where}: {name!r} is not a name; give one without control characters")
    code = cell("code", -1.0)  # below 0: this disc has none
    if code != int(code):
        raise KgcpError(f"{where}: code {code:g} is not a whole number; correct it")
    return FieldPoint(
        name,
        three(_PLACE),
        cell("diameter_m", diameter_m),
        cell("inner_diameter_m", inner_m),
        three(_NORMAL) if _NORMAL[0] in columns.names else _UPRIGHT,
        three(_SDS) if _SDS[0] in columns.names else None,
        int(code) if code >= 0.0 else None,
    )


def point_lines(field: PointField) -> Iterator[str]:
    """Yield the lines of a field.toml that say which discs a field has."""
    if field.code is not None:
        ring = [field.code.inner, field.code.outer]
        yield from ("\n[code]", 'kind = "ring"', f"bits = {field.code.bits}", f"ring = {ring}")
    for point in field.points:
        yield "\n[[point]]"
        yield f"name = {toml_text(point.name)}"
        yield f"position_m = {list(point.position_m)}"
        yield f"diameter_m = {point.diameter_m!r}"
        if point.inner_diameter_m:
            yield f"inner_diameter_m = {point.inner_diameter_m!r}"
        if point.normal != _UPRIGHT:
            yield f"normal = {list(point.normal)}"
        if point.sd_m is not None:
            yield f"sd_m = {list(point.sd_m)}"
        if point.code is not None:
            yield f"code = {point.code}"
