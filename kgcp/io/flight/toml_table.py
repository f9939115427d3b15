"""Typed access to the tables of a TOML file; errors name file, table and key."""

from __future__ import annotations

import difflib
import json
import os
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import TypeVar

from kgcp.errors import KgcpError, SettingError
from kgcp.io.files.safe_read import LARGEST, is_file, is_missing, remedy_for_missing

Value = TypeVar("Value")
Word = TypeVar("Word", bound=str)

_TYPE_NAMES = {
    bool: "a boolean",
    int: "a number",
    float: "a number",
    str: "a text",
    list: "a list",
    dict: "a table",
}
_LONGEST_NAME = 200
_ESCAPED = "\b\t\n\f\r"  # what TOML makes of a backslash and a letter
_CONTROLS = ("Cc", "Zl", "Zp")  # Unicode's: control characters, ends of lines and paragraphs


@dataclass(frozen=True, slots=True)
class TomlTable:
    """One table of a file, of which all keys are known.

    Raises
    ------
    KgcpError
        On making one, for a key that is not known; it names the nearest known key.
    """

    where: str  # the file and the table, for messages: `flight.toml: [camera]`
    values: Mapping[str, object]
    known: Sequence[str]

    def __post_init__(self) -> None:
        for key in self.values:
            if key not in self.known:
                nearest = difflib.get_close_matches(key, self.known, n=1, cutoff=0.0)[0]
                raise KgcpError(
                    f"{self.where} {key}: is not a known key; the nearest known key is '{nearest}'"
                )

    def __contains__(self, key: str) -> bool:
        return key in self.values

    @contextmanager
    def located(self) -> Iterator[None]:
        """Name the file and the table in a `SettingError` that the block raises."""
        try:
            yield
        except SettingError as error:
            raise KgcpError(f"{self.where} {error}") from None

    def error(self, key: str, problem: str, remedy: str) -> KgcpError:
        """Return the error for a value of this table, to be raised."""
        return KgcpError(f"{self.where} {SettingError(key, problem, remedy)}")

    def text(self, key: str) -> str:
        """Return a text that is not empty."""
        value = self._required(key, "give it as a text in quotes")
        if not isinstance(value, str):
            raise self._wrong_type(key, value, "a text in quotes")
        if not value.strip():
            raise self.error(key, "is empty", "give a text or delete the line")
        return value

    def name(self, key: str) -> str:
        """Return a name: one line that can be shown in any table or page."""
        value = self.text(key)
        if len(value) > _LONGEST_NAME or any(
            unicodedata.category(character) in _CONTROLS for character in value
        ):
            problem = f"{value[:20]!r} is not a name"
            remedy = (
                f"give at most {_LONGEST_NAME} characters on one line, without control characters"
            )
            raise self.error(key, problem, remedy)
        return value

    def optional(self, key: str, read: Callable[[str], Value]) -> Value | None:
        """Return what a method of this table reads under a key; None where the key is absent."""
        return read(key) if key in self else None

    def choice(self, key: str, words: Iterable[Word]) -> Word:
        """Return one of the given words: texts, or the members of a `StrEnum`."""
        text = self.text(key)
        for word in words:
            if word == text:
                return word
        listed = ", ".join(f'"{word}"' for word in words)
        raise self.error(key, f"{text!r} is not known", f"give one of {listed}")

    def mark(self, key: str, marks: Sequence[str]) -> str:
        """Return one of the given characters, white space among them."""
        value = self._required(key, "give it as a text in quotes")
        if value not in marks:
            listed = ", ".join(map(json.dumps, marks))
            raise self.error(key, f"{value!r} is not known", f"give one of {listed}")
        return str(value)

    def boolean(self, key: str, *, default: bool) -> bool:
        """Return true or false, or the default where the key is absent."""
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise self._wrong_type(key, value, "true or false")
        return value

    def integer(self, key: str) -> int:
        """Return a whole number; booleans are refused."""
        value = self._required(key, "give it as a whole number")
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._wrong_type(key, value, "a whole number")
        if abs(value) >= LARGEST:
            raise self.error(key, "is too large", "give a number in range")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number, or the default where the key is absent; booleans are refused."""
        if default is not None and key not in self:
            return default
        return self._finite(key, self._required(key, "give it as a number"))

    def numbers(self, key: str, example: str = "[0, 43, 78]") -> tuple[float, ...]:
        """Return a list of finite numbers; the example is for messages."""
        value = self._required(key, f"give it as a list of numbers, {example}")
        if not isinstance(value, list):
            raise self._wrong_type(key, value, f"a list of numbers, {example}")
        return tuple(self._finite(key, element) for element in value)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts."""
        value = self._required(key, 'give it as a list of texts, ["fx", "fy"]')
        if not isinstance(value, list):
            raise self._wrong_type(key, value, 'a list of texts, ["fx", "fy"]')
        for element in value:
            if not isinstance(element, str):
                raise self._wrong_type(key, element, "a text in quotes")
        return tuple(value)

    def day(self, key: str) -> date:
        """Return a date, in quotes or not."""
        value = self._required(key, "give it as 2026-05-04")
        if isinstance(value, date) and not isinstance(value, datetime):
            return value
        try:
            return date.fromisoformat(value if isinstance(value, str) else "")
        except ValueError:
            raise self.error(key, f"{value!r} is not a date", "give it as 2026-05-04") from None

    def path(self, key: str, folder: Path) -> str:
        """Return a path relative to the folder, of a file that may come later."""
        text = self.text(key)
        has_escape = not set(text).isdisjoint(_ESCAPED)  # "data\track.csv" has a tab
        if has_escape or ("\\" in text and not os.path.lexists(folder / text)):
            raise self.error(key, f"{text!r} has a backslash", "write / instead of \\ in paths")
        return text

    def existing_file(self, key: str, folder: Path) -> Path:
        """Return a file that lies in the folder or below it; reading says if it is protected."""
        path = folder / self.path(key, folder)
        if not is_file(path):
            if os.path.lexists(path):
                raise self.error(key, f"{self.text(key)!r} is not a regular file", "name a file")
            if is_missing(path):
                remedy = remedy_for_missing(path, "create or correct it")
                raise self.error(key, f"{self.text(key)!r} does not exist", remedy)
        return path

    def vector(
        self,
        key: str,
        default: tuple[float, float, float] | None = None,
        example: str = "[x, y, z]",
    ) -> tuple[float, float, float]:
        """Return a list of exactly three finite numbers, or the default."""
        if default is not None and key not in self:
            return default
        values = self.numbers(key, example)
        if len(values) != 3:
            problem = f"has {len(values)} numbers instead of 3"
            points = "; decimals take a point" if len(values) == 6 else ""
            raise self.error(key, problem, f"give it as {example}{points}")
        return values[0], values[1], values[2]

    def table(self, key: str, known: Sequence[str], *, required: bool = True) -> TomlTable:
        """Return a sub-table with the keys that it may have; an empty one if it may be absent."""
        if not required and key not in self:
            return TomlTable(f"{self.where} [{key}]", {}, known)
        value = self._required(key, f"write a table [{key}]")
        if not isinstance(value, dict):
            raise self._wrong_type(key, value, f"a table [{key}]")
        return TomlTable(f"{self.where} [{key}]", value, known)

    def tables(self, key: str) -> tuple[Mapping[str, object], ...]:
        """Return an array of tables, not yet checked."""
        value = self._required(key, f"write at least one table [[{key}]]")
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self._wrong_type(key, value, f"tables, each headed [[{key}]]")
        if not value:
            raise self.error(key, "is empty", f"write at least one table [[{key}]]")
        return tuple(value)

    def _required(self, key: str, remedy: str) -> object:
        if key not in self.values:
            raise self.error(key, "is missing", remedy)
        return self.values[key]

    def _finite(self, key: str, value: object) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._wrong_type(key, value, "a number")
        if not abs(value) < LARGEST:
            shown = f"{value} is" if isinstance(value, float) else "is"  # integers have any length
            raise self.error(key, f"{shown} not a finite number", "give a number in range")
        return float(value)

    def _wrong_type(self, key: str, value: object, wanted: str) -> KgcpError:
        kind = _TYPE_NAMES.get(type(value), "a date or time")
        return self.error(key, f"is {kind}", f"give {wanted}")
