"""Columns of the tables that kgcp writes: name, type, and how a record gives the value.

Only docs/tables.md says what each column means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Generic, TypeVar

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.unix_time import date_of

Row = Mapping[str, object]
Record = TypeVar("Record")

SCHEMA_VERSION = "3"


class ColumnType(StrEnum):
    """Storage types of table columns; `TEXT`, `INTEGER` and `BOOLEAN` are never null."""

    TEXT = "text"
    INTEGER = "integer"
    BOOLEAN = "boolean"
    NUMBER = "number"
    TIME = "time"
    NUMBERS = "numbers"


TEXT, INTEGER, BOOLEAN = ColumnType.TEXT, ColumnType.INTEGER, ColumnType.BOOLEAN
NUMBER, NUMBERS, TIME = ColumnType.NUMBER, ColumnType.NUMBERS, ColumnType.TIME


@dataclass(frozen=True, slots=True)
class Column(Generic[Record]):
    """One column of a table: `get` returns its cell for a record, None for null.

    Older tables of the same version lack a column that `is_later`; it is null for their records.
    """

    name: str
    type: ColumnType
    get: Callable[[Record], object]
    is_later: bool = False

    @classmethod
    def of_vector(
        cls, names: Sequence[str], get: Callable[[Record], Sequence[float] | FloatArray | None]
    ) -> tuple[Column[Record], ...]:
        """Return a column for each element of a vector; null where a record has no vector."""

        def element(index: int) -> Column[Record]:
            def cell(record: Record) -> float | None:
                vector = get(record)
                return None if vector is None else float(vector[index])

            return cls(names[index], NUMBER, cell)

        return tuple(map(element, range(len(names))))

    @classmethod
    def of_sds(
        cls, names: Sequence[str], get: Callable[[Record], FloatArray | None]
    ) -> tuple[Column[Record], ...]:
        """Return a column of standard deviations for each of a covariance's first axes."""

        def deviation(axis: int) -> Column[Record]:
            return cls(names[axis], NUMBER, lambda record: sd_cell(get(record), axis))

        return tuple(map(deviation, range(len(names))))


def row_of(columns: Iterable[Column[Record]], record: Record) -> Row:
    """Return a record as a row: its cells by column name."""
    return {column.name: column.get(record) for column in columns}


def time_cell(time_s: float | None) -> datetime | None:
    """Return Unix seconds as a table cell: UTC, rounded to the microsecond."""
    return None if time_s is None else date_of(time_s)


def matrix_cell(matrix: FloatArray | None) -> list[float] | None:
    """Return the elements of a matrix, row by row."""
    return None if matrix is None else matrix.ravel().tolist()


def finite_cell(value: float) -> float | None:
    """Return a number as a table cell: null where it is not finite."""
    return value if math.isfinite(value) else None


def sd_cell(cov: FloatArray | None, axis: int) -> float | None:
    """Return the standard deviation along one axis of a covariance."""
    return None if cov is None else float(np.sqrt(cov[axis, axis]))
