"""field.toml, and every other way to say what a field of targets is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from kgcp.errors import KgcpError, SettingError
from kgcp.io.files.safe_read import is_file
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.flight.point_field_file import POINT_KEYS, point_field, point_lines, points_file
from kgcp.io.flight.toml_draft import toml_text
from kgcp.io.flight.toml_file import read_toml
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.formats.fields import FORMATS, WITHOUT_UNIT
from kgcp.targets.fields.layout import Field, FieldBar, FieldPolarity, GridKind, Mark
from kgcp.targets.fields.points import AnyField, PointField

FIELD_KEYS = (
    *("name", "polarity", "diameter_m", "inner_diameter_m", "flat_sd_m", "grid", "mark", "bar"),
    *POINT_KEYS,
)
GRID_KEYS = ("kind", "columns", "rows", "pitch_m")
MARK_KEYS = ("at", "diameter_m", "inner_diameter_m", "missing")
BAR_KEYS = ("from", "to", "length_m", "sd_m")

_SHORTHAND = re.compile(
    r"(grid|square|asymmetric|hexagonal):(\d{1,4})x(\d{1,4}):([^:]+)"
    r"(?::((?!dark|bright)[^:]+))?(?::(dark|bright))?"
)
_LENGTH = re.compile(r"(\d+(?:\.\d+)?|\.\d+)\s*(mm|cm|m|in)")
_METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}
_USUAL_SHARE = 0.5  # of the pitch: assumed diameter until it is measured
_EXAMPLE = "grid:10x8:25mm:15mm"


def read_field(text: str, unit: str | None = None) -> AnyField:
    """Return the field that a shorthand or a file describes.

    Parameters
    ----------
    text : str
        `grid:10x8:25mm:15mm[:bright]`, likewise asymmetric and hexagonal: columns x rows, pitch,
        diameter. Or the path of a field.toml or of another program's board.
    unit : str, optional
        mm, cm, m or in: what a board's file that does not say so counts in.

    Raises
    ------
    KgcpError
        Naming the text, or file and key, and the remedy; also if a unit is given for what has one.
    """
    shorthand = _SHORTHAND.fullmatch(text)
    if shorthand is not None:
        _refuse_unit(text, unit)
        return _from_shorthand(text, shorthand)
    path = Path(text)
    if not is_file(path):
        raise KgcpError(
            f"{text}: is neither a field's file nor a shorthand such as {_EXAMPLE}; correct it",
            option="field",
        )
    if path.suffix == ".toml":
        _refuse_unit(text, unit)
        return _from_toml(path)
    file = ForeignFile(path, "the field")
    form = FORMATS.recognised(file)
    if form not in WITHOUT_UNIT:
        _refuse_unit(text, unit)
    try:
        return FORMATS.reader(file, form)(file, None if unit is None else _METRES[unit])
    except SettingError as error:
        raise KgcpError(f"{path}: {error}") from None


def _refuse_unit(text: str, unit: str | None) -> None:
    if unit is not None:
        raise KgcpError(
            f"{text}: states its own unit of length, so that {unit!r} would be ignored; leave it"
            " out",
            option="unit",
        )


def refuse_to_overwrite_field(text: str, written: Iterable[Path]) -> None:
    """Refuse to write over the files that `read_field` reads of a field.

    Raises
    ------
    KgcpError
        Naming the file.
    """
    path = Path(text)
    if not is_file(path):
        return
    own = [path]
    if path.suffix == ".toml":
        table, _ = read_toml(path, FIELD_KEYS, "the field")
        own += [points_file(table, path.parent)] if "points" in table else []
    for target in written:
        if target.exists() and any(target.samefile(file) for file in own):
            raise KgcpError(
                f"{target}: describes the field and would be overwritten; write to another folder",
                option="out",
            )


def _from_shorthand(text: str, match: re.Match[str]) -> Field:
    kind, columns, rows, pitch, diameter, polarity = match.groups()
    pitch_m = _length_m(text, pitch)
    diameter_m = _USUAL_SHARE * pitch_m if diameter is None else _length_m(text, diameter)
    try:
        return Field(
            text,
            GridKind.SQUARE if kind == "grid" else GridKind(kind),
            int(columns),
            int(rows),
            pitch_m,
            diameter_m,
            polarity=FieldPolarity(polarity or "dark"),
            is_diameter_stated=diameter is not None,
        )
    except SettingError as error:
        raise KgcpError(f"{text}: {error}", option="field") from None


def _length_m(text: str, length: str) -> float:
    match = _LENGTH.fullmatch(length.strip())
    if match is None:
        raise KgcpError(
            f"{text}: {length!r} is not a length with a unit; write it like {_EXAMPLE}",
            option="field",
        )
    return float(match[1]) * _METRES[match[2]]


def _from_toml(path: Path) -> AnyField:
    table, _ = read_toml(path, FIELD_KEYS, "the field")
    name = table.optional("name", table.name) or path.stem
    polarity = table.optional("polarity", lambda key: table.choice(key, FieldPolarity))
    polarity = polarity or FieldPolarity.DARK
    values: dict[str, Any] = {}
    if "flat_sd_m" in table:
        values["flat_sd_m"] = table.vector("flat_sd_m")
    if "points" in table or "point" in table:
        for key in ("grid", "mark"):
            if key in table:
                raise table.error(key, "is given beside points", "give a grid or points, not both")
        return point_field(table, path.parent, name, polarity, _bars(table))
    if "code" in table:
        raise table.error("code", "is given beside a grid", "give codes with points")
    grid = table.table("grid", GRID_KEYS)
    diameter_m = table.number("diameter_m")
    with table.located():
        return Field(
            name,
            grid.choice("kind", GridKind),
            grid.integer("columns"),
            grid.integer("rows"),
            grid.number("pitch_m"),
            diameter_m,
            table.number("inner_diameter_m", 0.0),
            polarity,
            _marks(table, diameter_m),
            bars=_bars(table),
            **values,
        )


def _marks(table: TomlTable, diameter_m: float) -> tuple[Mark, ...]:
    rows = table.tables("mark") if "mark" in table else ()
    return tuple(_mark(table, row, diameter_m) for row in rows)


def _mark(table: TomlTable, values: Mapping[str, object], diameter_m: float) -> Mark:
    mark = TomlTable(f"{table.where} [[mark]]", values, MARK_KEYS)
    place = mark.numbers("at", "[2, 2]")
    if len(place) != 2 or any(value != int(value) for value in place):
        raise mark.error("at", "is not column and row", "give it as [2, 2]")
    return Mark(
        int(place[0]),
        int(place[1]),
        mark.number("diameter_m", diameter_m),
        mark.number("inner_diameter_m", 0.0),
        mark.boolean("missing", default=False),
    )


def _bars(table: TomlTable) -> tuple[FieldBar, ...]:
    rows = table.tables("bar") if "bar" in table else ()
    bars = [TomlTable(f"{table.where} [[bar]]", row, BAR_KEYS) for row in rows]
    return tuple(
        FieldBar(bar.text("from"), bar.text("to"), bar.number("length_m"), bar.number("sd_m"))
        for bar in bars
    )


def field_toml(field: AnyField) -> str:
    """Return the text of a field.toml, which `read_field` reads back to the same field."""
    lines = [
        f"name = {toml_text(field.name)}",
        f'polarity = "{field.polarity.value}"',
        f"flat_sd_m = {list(field.flat_sd_m)}",
        *(point_lines(field) if isinstance(field, PointField) else _grid_lines(field)),
    ]
    for bar in field.bars:
        lines += [
            "\n[[bar]]",
            f"from = {toml_text(bar.first)}",
            f"to = {toml_text(bar.second)}",
            f"length_m = {bar.length_m!r}",
            f"sd_m = {bar.sd_m!r}",
        ]
    return "\n".join(lines) + "\n"


def _grid_lines(field: Field) -> Iterator[str]:
    yield f"diameter_m = {field.diameter_m!r}"
    if field.inner_diameter_m:
        yield f"inner_diameter_m = {field.inner_diameter_m!r}"
    yield "\n[grid]"
    yield f'kind = "{field.kind.value}"'
    yield f"columns = {field.columns}"
    yield f"rows = {field.rows}"
    yield f"pitch_m = {field.pitch_m!r}"
    for mark in field.marks:
        yield "\n[[mark]]"
        yield f"at = [{mark.column}, {mark.row}]"
        if mark.is_missing:
            yield "missing = true"
            continue
        yield f"diameter_m = {mark.diameter_m!r}"
        if mark.inner_diameter_m:
            yield f"inner_diameter_m = {mark.inner_diameter_m!r}"
