"""Parquet tables with declared columns, written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import unwritable, whole_file
from kgcp.io.files.safe_read import is_no_file, unreadable
from kgcp.io.tables.columns import SCHEMA_VERSION, Column, ColumnType, Row

if TYPE_CHECKING:  # 0.3 s that writing does not need
    import pandas as pd

_ARROW_TYPES = {
    ColumnType.TEXT: pa.string(),
    ColumnType.INTEGER: pa.int64(),
    ColumnType.BOOLEAN: pa.bool_(),
    ColumnType.NUMBER: pa.float64(),
    ColumnType.TIME: pa.timestamp("us", tz="UTC"),
    ColumnType.NUMBERS: pa.list_(pa.float64()),
}
_KEYS = ("frame", "target", "instance", "status")  # columns without null
_ROWS_PER_GROUP = 4096  # as many rows are in memory at once


def write_table(
    path: Path, columns: Sequence[Column[Any]], rows: Iterable[Row], metadata: Mapping[str, str]
) -> None:
    """Write rows as Parquet to a temporary file, and rename that to `path`.

    Parameters
    ----------
    columns : sequence of Column
        The declared columns; a row that lacks one or has others is a programming error.
    rows : iterable of mapping
        Column name to value; None is null. Only one row group is in memory at a time.

    Raises
    ------
    KgcpError
        If the file cannot be written.
    """
    schema = pa.schema(
        [pa.field(column.name, _ARROW_TYPES[column.type]) for column in columns],
        metadata={f"kgcp.{key}": value for key, value in metadata.items()},
    )
    remaining = iter(rows)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
            writer.write_table(_table(schema, islice(remaining, _ROWS_PER_GROUP)))
            for row in remaining:
                group = chain((row,), islice(remaining, _ROWS_PER_GROUP - 1))
                writer.write_table(_table(schema, group))
    except OSError as error:
        raise unwritable(path, error) from error


def _table(schema: pa.Schema, rows: Iterable[Row]) -> pa.Table:
    cells: dict[str, list[Any]] = {name: [] for name in schema.names}
    for row in rows:
        if row.keys() != cells.keys():
            raise ValueError(f"row and columns differ in {sorted(row.keys() ^ cells.keys())}")
        for name, column in cells.items():
            column.append(row[name])
    return pa.table(cells, schema=schema)


def read_table(path: Path, columns: Sequence[Column[Any]]) -> pd.DataFrame:
    """Read a table that `write_table` wrote, or pandas from such a table.

    Raises
    ------
    KgcpError
        If the file is missing, not Parquet, of another version, lacks declared columns that are not
        later ones, or has columns with another type, twice, or with null in a key.
    """
    if is_no_file(path):
        raise KgcpError(f"{path}: does not exist; run the command that writes it first")
    try:
        table = pq.read_table(path)
    except PermissionError as error:
        raise unreadable(path, error, "make it readable") from error
    except (OSError, pa.ArrowException) as error:
        reason = (str(error).splitlines() or ["damaged"])[0]
        raise KgcpError(f"{path}: is not a readable Parquet table ({reason}); remake it") from error
    _check_version(path, table.schema.metadata or {})
    for column in columns:
        if column.is_later and column.name not in table.column_names:
            cells = pa.nulls(len(table), _ARROW_TYPES[column.type])
            table = table.append_column(column.name, cells)
    missing = [column.name for column in columns if column.name not in table.column_names]
    if missing:
        raise KgcpError(
            f"{path}: lacks the columns {', '.join(missing)}; remake it with this version of kgcp"
        )
    table = _with_declared_types(table, columns)
    _check_columns(path, table, columns)
    frame: pd.DataFrame = table.to_pandas()
    return frame


def _with_declared_types(table: pa.Table, columns: Sequence[Column[Any]]) -> pa.Table:
    """Return a table with the types of `write_table` where pandas writes another for them.

    These are texts of any length, and columns without a value.
    """
    for column in columns:
        index = table.schema.get_field_index(column.name)  # -1: occurs twice
        declared = _ARROW_TYPES[column.type]
        actual = table.schema.field(index).type if index >= 0 else declared
        is_text = pa.types.is_large_string(actual) and column.type is ColumnType.TEXT
        if is_text or pa.types.is_null(actual):
            cells = table.column(index).cast(declared)
            table = table.set_column(index, pa.field(column.name, declared), cells)
    return table


def _check_version(path: Path, metadata: Mapping[bytes, bytes]) -> None:
    """Refuse a table of another version, whose columns may mean something else."""
    version = metadata.get(b"kgcp.schema_version", SCHEMA_VERSION.encode()).decode(errors="replace")
    if version != SCHEMA_VERSION:
        raise KgcpError(
            f"{path}: is a table of version {version}, not {SCHEMA_VERSION};"
            " remake it with this version of kgcp"
        )


def _check_columns(path: Path, table: pa.Table, columns: Sequence[Column[Any]]) -> None:
    """Refuse columns that have another type than declared, occur twice, or lack keys."""
    for column in columns:
        indices = table.schema.get_all_field_indices(column.name)
        actual_type = table.schema.field(indices[0]).type
        declared_type = _ARROW_TYPES[column.type]
        if len(indices) > 1 or actual_type != declared_type:
            problem = (
                "occurs twice"
                if len(indices) > 1
                else f"has the type {actual_type}, not {declared_type}"
            )
            raise KgcpError(f"{path}: the column {column.name} {problem}; remake it with kgcp")
        if column.name in _KEYS and table.column(column.name).null_count:
            raise KgcpError(
                f"{path}: the column {column.name} has empty cells; remake it with kgcp"
            )
