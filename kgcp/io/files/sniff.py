"""Files of other programs: read once, recognised by their content."""

from __future__ import annotations

import json
import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

# expat fetches nothing, and declarations of entities, which may multiply, are refused below.
from xml.etree import ElementTree as ET

from kgcp.errors import KgcpError
from kgcp.io.files.safe_read import is_sound, read_bytes

_ENTITY = re.compile(r"<!\s*ENTITY")


@dataclass(frozen=True, slots=True, eq=False)
class ForeignFile:
    """A file whose format its content tells.

    Attributes
    ----------
    path : Path
        Where it lies.
    text : str
        Its content, decoded as UTF-8; what is none, as in images, is replaced.
    document : object
        What it holds if it is JSON; else None.
    root : Element or None
        The root of its elements if it is XML.
    """

    path: Path
    text: str
    document: object
    root: ET.Element | None

    @classmethod
    def read(cls, path: Path, toml_key: str) -> Self:
        """Read a file that flight.toml names under `toml_key`.

        Raises
        ------
        KgcpError
            If it cannot be read.
        """
        text = read_bytes(path, toml_key).decode("utf-8-sig", errors="replace")
        return cls(path, text, _json(text), _xml(text))

    @property
    def rows(self) -> tuple[tuple[int, str], ...]:
        """Lines that are neither blank nor comments (#), with their numbers from 1."""
        lines = enumerate(self.text.splitlines(), start=1)
        stripped = ((number, line.strip()) for number, line in lines)
        return tuple((number, line) for number, line in stripped if line and line[0] != "#")

    def error(self, where: str, problem: str, remedy: str) -> KgcpError:
        """Return the error for one place of the file, to be raised."""
        return KgcpError(f"{self.path}{f', {where}' if where else ''}: {problem}; {remedy}")

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
            raise self.error(where, f"holds {shown!r} instead of {kind}", "export it again")
        return values


@dataclass(frozen=True, slots=True, eq=False)
class JsonObject:
    """An object of a JSON file that knows its place.

    Attributes
    ----------
    file : ForeignFile
    where : str
        Its place, for messages.
    values : mapping
    """

    file: ForeignFile
    where: str
    values: Mapping[str, object]

    @classmethod
    def of(cls, file: ForeignFile, where: str, value: object) -> Self:
        """Return the object, or raise `KgcpError` if the value is none."""
        if not isinstance(value, dict):
            raise file.error(where, "is no JSON object", "export it again")
        return cls(file, where, value)

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def __getitem__(self, key: str) -> object:
        if key not in self.values:
            raise self.file.error(self.where, f"has no {key!r}", "export it again")
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
            raise self.file.error(
                self.where, f"{key!r} is no list of {count} numbers", "export it again"
            )
        return tuple(self._finite(key, element) for element in value)

    def text(self, key: str) -> str:
        """Return a text or a whole number as text: ids are either."""
        value = self[key]
        if isinstance(value, bool) or not isinstance(value, str | int):
            raise self.file.error(self.where, f"{key!r} is no text", "export it again")
        return str(value)

    def child(self, key: str) -> JsonObject:
        """Return an object."""
        return JsonObject.of(self.file, f"{self.where} {key}".strip(), self[key])

    def children(self, key: str) -> tuple[JsonObject, ...]:
        """Return a list of objects."""
        value = self[key]
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise self.file.error(self.where, f"{key!r} is no list", "export it again")
        return tuple(
            JsonObject.of(self.file, f"{self.where} {key}[{index}]".strip(), element)
            for index, element in enumerate(value)
        )

    def _finite(self, key: str, value: object) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not is_sound(value):
            raise self.file.error(
                self.where, f"{key!r} is {reprlib.repr(value)}, no finite number", "export it again"
            )
        return float(value)


def _json(text: str) -> object:
    if text.lstrip()[:1] not in ("{", "["):
        return None
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _xml(text: str) -> ET.Element | None:
    if text.lstrip()[:1] != "<" or _ENTITY.search(text):
        return None
    try:
        return ET.fromstring(text)  # noqa: S314 - see the import
    except (ET.ParseError, ValueError):
        return None
