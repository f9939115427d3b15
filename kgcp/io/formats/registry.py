"""Formats of one kind of file: how the content is recognised, and the readers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from kgcp.io.files.csv_columns import SEPARATOR_REMEDY, foreign_separator
from kgcp.io.files.safe_read import ARCHIVES, UTF_16, likely_encoding, text_remedy
from kgcp.io.files.sniff import ForeignFile

Read = TypeVar("Read")
"""Type of the function that reads a file of some format."""

_CSV_NAMES = ("time", "frame", "x", "y", "z")  # columns; every CSV file has some of them


@dataclass(frozen=True, slots=True)
class Registry(Generic[Read]):
    """The formats that a file of one kind may have."""

    kind: str  # what a file of these formats is, for messages: "a calibration"
    remedy: str  # what to do with a file of another format
    # name in flight.toml → whether a file is of this format, and its reader. They are tried in this
    # order: the most specific first.
    formats: Mapping[str, tuple[Callable[[ForeignFile], bool], Read]]
    # what to do with a table whose cells are not separated by commas
    separator_remedy: str = SEPARATOR_REMEDY

    @property
    def names(self) -> Iterable[str]:
        """Names of the formats in flight.toml."""
        return self.formats.keys()

    def reader(self, file: ForeignFile, name: str | None = None) -> Read:
        """Return the reader of a format by its name; None: by the file's content.

        Raises
        ------
        KgcpError
            If the content is of no known format.
        """
        name = self.recognised(file) if name is None else name
        return self.formats[name][1]

    def recognised(self, file: ForeignFile) -> str:
        """Return the name of a file's format.

        Raises
        ------
        KgcpError
            If the file has none of these formats.
        """
        for name, (matches, _) in self.formats.items():
            if matches(file):
                return name
        if file.head.startswith(UTF_16 + ARCHIVES):
            likely = likely_encoding(file.head)
            raise file.error(f"is {likely}, not {self.kind}", text_remedy(file.head))
        separator = foreign_separator(file.first_line, _CSV_NAMES)
        if "csv" in self.formats and separator is not None:
            raise file.error(
                f"is not {self.kind} of a known format: its cells are separated by {separator}",
                self.separator_remedy,
            )
        known = ", ".join(sorted(self.formats))
        raise file.error(f"is not {self.kind} of a known format ({known})", self.remedy)
