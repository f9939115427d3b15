"""Tables as comma-separated text."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence

DEGREE_DECIMALS = 12
"""Of geographic coordinates, by which 0.1 µm shows."""


_SEPARATOR_LINE = re.compile(r"sep=.\s*", re.IGNORECASE)


def is_separator_line(line: str) -> bool:
    """Return whether this is a line `sep=;`, by which other programs tell Excel the separator."""
    return _SEPARATOR_LINE.fullmatch(line) is not None


def csv_text(columns: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a line with the columns' names and one for each row."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()
