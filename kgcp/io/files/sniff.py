"""Files of other programs: read once, recognised by their content."""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

# expat fetches nothing, and declarations of entities, which may multiply, are refused below.
from xml.etree import ElementTree as ET

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.csv_text import is_separator_line
from kgcp.io.files.safe_read import is_sound, read_bytes, require_file, unreadable

_ENTITY = re.compile(r"<!\s*ENTITY")
_HEAD = 4096


@dataclass(frozen=True, eq=False)
class ForeignFile:
    """A file whose format follows from its content; each part is read when first needed."""

    path: Path
    toml_key: str  # where flight.toml names it, for messages
    remedy: str = "export it again"  # what to do if its content is wrong

    @cached_property
    def head(self) -> bytes:
        """The first bytes, enough to recognise a format.

        Raises
        ------
        KgcpError
            If it is not a regular file or cannot be read.
        """
        require_file(self.path, self.toml_key)
        try:
            with self.path.open("rb") as stream:
                return stream.read(_HEAD)
        except OSError as error:
            raise unreadable(self.path, error, "make it readable") from error

    @property
    def first_line(self) -> str:
        """The first line with content, no comment (#) or `sep=;`; empty if it is not text."""
        if b"\0" in self.head:
            return ""
        rows = self.head.decode("utf-8-sig", errors="replace").splitlines()
        return next((row for row in rows if _has_content(row)), "")

    @cached_property
    def text(self) -> str:
        """The content as UTF-8; bytes that are not, as in images, are replaced.

        Raises
        ------
        KgcpError
            If it cannot be read.
        """
        return read_bytes(self.path, self.toml_key).decode("utf-8-sig", errors="replace")

    @cached_property
    def document(self) -> object:
        """The content if it is JSON; else None."""
        if self.text.lstrip()[:1] not in ("{", "["):
            return None
        try:
            return json.loads(self.text)
        except (ValueError, RecursionError):
            return None

    @cached_property
    def root(self) -> ET.Element | None:
        """The root of the elements if it is XML; else None."""
        if self.text.lstrip()[:1] != "<" or _ENTITY.search(self.text):
            return None
        try:
            return ET.fromstring(self.text)  # noqa: S314 - see the import
        except (ET.ParseError, ValueError):
            return None

    @property
    def rows(self) -> tuple[tuple[int, str], ...]:
        """Lines that are neither blank nor comments (#), with their numbers from 1."""
        lines = enumerate(self.text.splitlines(), start=1)
        stripped = ((number, line.strip()) for number, line in lines)
        return tuple((number, line) for number, line in stripped if line and line[0] != "#")

    def error(self, problem: str, remedy: str | None = None) -> KgcpError:
        """Return the error for the file as a whole, to be raised."""
        return self.error_at("", problem, remedy)

    def error_at(self, where: str, problem: str, remedy: str | None = None) -> KgcpError:
        """Return the error for one place in the file, to be raised; "": the whole file."""
        place = f"{self.path}, {where}" if where else str(self.path)
        return KgcpError(f"{place}: {problem}; {remedy or self.remedy}")

    def numbers(self, text: str | None, count: int, where: str) -> tuple[float, ...]:
        """Return the `count` numbers of a text, which white space separates."""
        words = (text or "").split()
        try:
            values = tuple(float(word) for word in words)
        except ValueError:
            values = ()
        if len(values) != count or not all(map(is_sound, values)):
            found = " ".join(words) or "nothing"
            shown = found if len(found) <= 60 else f"{found[:57]}..."
            kind = "a finite number" if count == 1 else f"{count} finite numbers"
            raise self.error_at(where, f"holds {shown!r} instead of {kind}")
        return values


def _has_content(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("#") and not is_separator_line(line)


@dataclass(frozen=True, slots=True, eq=False)
class NamedValues:
    """Named values of a file that know their place: a JSON object, or a group of libconfig."""

    file: ForeignFile
    where: str  # its place in the file, for messages
    values: Mapping[str, object]

    @classmethod
    def of(cls, file: ForeignFile, where: str, value: object) -> Self:
        """Return the object, or raise `KgcpError` if the value is not one."""
        if not isinstance(value, dict):
            raise file.error_at(where, "is not a group of named values")
        return cls(file, where, value)

    def error(self, problem: str, remedy: str | None = None) -> KgcpError:
        """Return the error for this group, to be raised."""
        return self.file.error_at(self.where, problem, remedy)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def __getitem__(self, key: str) -> object:
        if key not in self.values:
            raise self.error(f"has no {key!r}")
        return self.values[key]

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        if default is not None and key not in self.values:
            return default
        return self._finite(key, self[key])

    def vector(self, key: str, count: int) -> tuple[float, ...]:
        """Return a list of `count` finite numbers."""
        value = self[key]
        if not isinstance(value, list) or len(value) != count:
            raise self.error(f"{key!r} is not a list of {count} numbers")
        return tuple(self._finite(key, element) for element in value)

    def text(self, key: str) -> str:
        """Return a text or a whole number as text: ids are either."""
        value = self[key]
        if isinstance(value, bool) or not isinstance(value, str | int):
            raise self.error(f"{key!r} is not a text")
        return str(value)

    def child(self, key: str) -> NamedValues:
        """Return an object."""
        return NamedValues.of(self.file, f"{self.where} {key}".strip(), self[key])

    def children(self, key: str) -> tuple[NamedValues, ...]:
        """Return a list of objects."""
        value = self[key]
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise self.error(f"{key!r} is not a list")
        return tuple(
            NamedValues.of(self.file, f"{self.where} {key}[{index}]".strip(), element)
            for index, element in enumerate(value)
        )

    def _finite(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not is_sound(value):
            raise self.error(f"{key!r} is {reprlib.repr(value)}, not a finite number")
        return float(value)


def vectors(objects: Sequence[NamedValues], key: str) -> FloatArray:
    """Return the lists of three numbers (n, 3) that n objects have under a key."""
    return np.array([each.vector(key, 3) for each in objects]).reshape(-1, 3)
