"""Tables are read back as written; impossible and damaged ones are errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from kgcp.errors import KgcpError
from kgcp.io.tables.columns import Column, ColumnType, Row, time_cell
from kgcp.io.tables.detections import read_detections
from kgcp.io.tables.parquet import read_table, write_table

COLUMNS: tuple[Column[Row], ...] = (
    Column("name", ColumnType.TEXT, str),
    Column("count", ColumnType.INTEGER, str),
    Column("value_m", ColumnType.NUMBER, str),
    Column("time", ColumnType.TIME, str),
    Column("cov", ColumnType.NUMBERS, str),
)
MOMENT = datetime(2026, 6, 16, 8, 15, 0, 123457, UTC)
ROWS: tuple[Row, ...] = (
    {"name": "a", "count": 0, "value_m": 0.1 + 0.2, "time": MOMENT, "cov": [1.0, 2.0, 1e-300]},
    {"name": "ü/b", "count": -3, "value_m": None, "time": None, "cov": None},
)


def one_line(error: BaseException) -> str:
    text = str(error)
    assert "\n" not in text
    return text


def test_values_and_nulls_are_read_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "t.parquet"
    write_table(path, COLUMNS, ROWS, {"version": "1.2", "toml": 'a = "ä"\n'})
    full, empty = read_table(path, COLUMNS).to_dict("records")
    assert full["value_m"] == 0.1 + 0.2
    assert full["time"] == pd.Timestamp(MOMENT)
    np.testing.assert_array_equal(full["cov"], [1.0, 2.0, 1e-300])
    assert (empty["name"], empty["count"]) == ("ü/b", -3)
    assert pd.isna(empty["value_m"])
    assert pd.isna(empty["time"])
    assert empty["cov"] is None
    metadata = pq.read_schema(path).metadata
    assert metadata[b"kgcp.version"] == b"1.2"
    assert metadata[b"kgcp.toml"].decode() == 'a = "ä"\n'
    assert [each.name for each in path.parent.iterdir()] == ["t.parquet"]


def test_types_do_not_depend_on_the_values(tmp_path: Path) -> None:
    """A column without a value, and a table without a row, keep their declared types."""
    for number, rows in enumerate((ROWS, ROWS[1:], ())):
        write_table(tmp_path / str(number), COLUMNS, rows, {})
    schemas = [pq.read_schema(tmp_path / str(number)) for number in range(3)]
    assert schemas[0].equals(schemas[1])
    assert schemas[0].equals(schemas[2])
    assert str(schemas[0].field("time").type) == "timestamp[us, tz=UTC]"


def test_the_same_rows_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_table(tmp_path / name, COLUMNS, ROWS, {"version": "1"})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("change", [{"value": 1.0}, {"count": None}])
def test_rows_of_other_columns_are_a_programming_error(
    change: dict[str, object], tmp_path: Path
) -> None:
    row = {**ROWS[0], **change}
    if "count" in change:
        del row["count"]
    with pytest.raises(ValueError, match=next(iter(change))):
        write_table(tmp_path / "t.parquet", COLUMNS, (ROWS[0], row), {})
    assert list(tmp_path.iterdir()) == []


def test_rows_that_fail_half_way_leave_the_old_table(tmp_path: Path) -> None:
    def broken() -> Iterator[Row]:
        yield ROWS[0]
        raise LookupError

    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS, ROWS[1:], {})
    before = path.read_bytes()
    with pytest.raises(LookupError):
        write_table(path, COLUMNS, broken(), {})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_impossible_folder_is_a_known_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(
        KgcpError, match=r"cannot be written .* choose another results folder"
    ) as caught:
        write_table(tmp_path / "file" / "t.parquet", COLUMNS, ROWS, {})
    one_line(caught.value)


def test_a_table_that_cannot_take_its_place_leaves_nothing(tmp_path: Path) -> None:
    occupied = tmp_path / "t.parquet"
    (occupied / "something").mkdir(parents=True)
    with pytest.raises(KgcpError, match="is a folder"):
        write_table(occupied, COLUMNS, ROWS, {})
    assert list(tmp_path.iterdir()) == [occupied]


def test_missing_and_damaged_tables_are_a_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(KgcpError, match="run 'kgcp detect' on this flight first") as caught:
        read_detections(tmp_path / "detections.parquet")
    one_line(caught.value)
    with pytest.raises(KgcpError, match="does not exist"):
        read_table(tmp_path / "t.parquet", COLUMNS)
    whole = tmp_path / "whole.parquet"
    write_table(whole, COLUMNS, ROWS, {})
    content = whole.read_bytes()
    for damaged in (b"", b"not a table at all", content[: len(content) // 2], content[:-1]):
        path = tmp_path / "damaged.parquet"
        path.write_bytes(damaged)
        with pytest.raises(KgcpError, match="is not a readable Parquet table") as caught:
            read_table(path, COLUMNS)
        assert str(path) in one_line(caught.value)


@pytest.mark.parametrize("version", ["2", "99"])
def test_a_table_of_another_version_is_refused(tmp_path: Path, version: str) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS, ROWS, {"schema_version": version})
    with pytest.raises(KgcpError, match=f"is a table of version {version}, not 3; remake it"):
        read_table(path, COLUMNS)


def test_a_table_of_other_columns_is_named_with_what_it_lacks(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS[:1], [{"name": "a"}], {})
    with pytest.raises(KgcpError, match="lacks the columns count, value_m, time, cov;") as caught:
        read_table(path, COLUMNS)
    one_line(caught.value)


def test_a_column_that_is_later_than_the_table_is_null(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, COLUMNS, ROWS, {})
    sizes = Column("size_m", ColumnType.NUMBER, str, is_later=True)
    later = Column("sizes_m", ColumnType.NUMBERS, str, is_later=True)
    table = read_table(path, (*COLUMNS, sizes, later))
    assert table[["size_m", "sizes_m"]].isna().all(axis=None)
    assert table["size_m"].dtype == np.float64
    with pytest.raises(KgcpError, match="lacks the columns size_m;"):
        read_table(path, (*COLUMNS, replace(sizes, is_later=False)))


@pytest.mark.parametrize(
    ("time_s", "microsecond"),
    [(1_781_597_700.1234564, 123456), (1_781_597_700.1234568, 123457), (1_781_597_700.0, 0)],
)
def test_times_are_rounded_to_the_microsecond(time_s: float, microsecond: int) -> None:
    expected = datetime(2026, 6, 16, 8, 15, 0, microsecond, UTC)
    assert time_cell(time_s) == expected


def test_times_before_1970_and_missing_times_can_be_written() -> None:
    assert time_cell(-0.5) == datetime(1969, 12, 31, 23, 59, 59, 500_000, UTC)
    assert time_cell(None) is None
