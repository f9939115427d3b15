"""A commented flight.toml, made of what is known: keys with values, and keys to be filled in."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date

from kgcp.errors import one_line

_COMMENT_COLUMN = 44
MISSING = "MISSING"
"""What stands in front of a comment on a key that a command will ask for."""

TomlValue = str | float | bool | date | Sequence[float] | Mapping[str, str]


@dataclass(frozen=True, slots=True)
class DraftKey:
    """One line of a table."""

    key: str
    value: TomlValue | None  # None: not known; the line is a comment
    comment: str = ""
    example: str = ""  # TOML of a value that is not known
    is_missing: bool = False  # whether a command needs the value

    def line(self) -> str:
        """Return the line, without its end."""
        if self.value is None:
            note = f"{MISSING}: {self.comment}" if self.is_missing else self.comment
            return _commented(f"# {self.key} = {self.example}", note)
        return _commented(f"{self.key} = {toml_text(self.value)}", self.comment)


@dataclass(frozen=True, slots=True)
class DraftTable:
    """One table, or the lines before all tables."""

    heading: str  # "[camera]"; empty: before all tables
    keys: tuple[DraftKey, ...]
    note: str = ""  # comment below the heading

    def lines(self) -> Iterator[str]:
        """Yield the lines, the first of them empty; a table without values is a comment."""
        yield ""
        if self.heading:
            is_set = any(key.value is not None for key in self.keys)
            yield self.heading if is_set else f"# {self.heading}"
        if self.note:
            yield f"# {one_line(self.note)}"
        for key in self.keys:
            yield key.line()


def _commented(text: str, comment: str) -> str:
    """Return a line with a comment, which may quote names of files and must not end the line."""
    return f"{text:<{_COMMENT_COLUMN - 2}}  # {one_line(comment)}" if comment else text


def toml_text(value: TomlValue) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, Mapping):
        pairs = ", ".join(f"{key} = {toml_text(each)}" for key, each in value.items())
        return f"{{ {pairs} }}"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(toml_text, value))}]"
    return repr(value)


@dataclass(frozen=True, slots=True)
class DraftText:
    """Tables that are written already."""

    written: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """Yield the lines; the first of them begins with an empty one."""
        return iter(self.written)
