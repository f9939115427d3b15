"""A TOML file as a table whose keys are known, and what is wrong with one that is not TOML."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.safe_read import likely_encoding, read_bytes
from kgcp.io.flight.toml_table import TomlTable

_MOST_BYTES = 1 << 18
# tomllib takes the square of the number of a key's parts.
_LONG_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"(?:[^"\\\n]|\\.){0,99}+"|'[^'\n]{0,99}+')[ \t]*+\.[ \t]*+){50}"""
)

_PLACE = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")
_DECLARED_TWICE = re.compile(r"Cannot declare \('(.+?)',\) twice")
_LONGEST_SHOWN = 60  # characters of a line
_CURLY_QUOTES = re.compile("[“”„‘’]")

# What a line looks like, what is wrong with it, and what to do; the first that fits.
_MISTAKES: Sequence[tuple[re.Pattern[str], str, str]] = (
    (_CURLY_QUOTES, "has curly quotes", 'write straight ones: "'),
    (re.compile(r'=\s*"[^"]*\\'), "has a backslash in a text", "write / instead of \\ in paths"),
    (
        re.compile(r"=\s*[-+]?\d+,\d+\s*(#|$)"),
        "has a decimal comma",
        "decimals take a point",
    ),
    (
        re.compile(r"=\s*[-+]?\d[\d.]*\s*[a-zA-Z°µ%]+\s*(#|$)"),
        "has a unit after the number",
        "give the number alone",
    ),
    (
        re.compile(r"=\s*(True|False|TRUE|FALSE)\b"),
        "has true or false in capitals",
        "write true or false in lower case",
    ),
    (re.compile(r"=\s*[A-Za-z_./]"), "has a text without quotes", 'put it in quotes: "…"'),
    (re.compile(r"^\s*[\w-]+\s*:"), "has : after the key", "write = between key and value"),
    (re.compile(r"=\s*(#|$)"), "has no value", "give the key a value or delete the line"),
)
# What tomllib says where the line is not the cause, and what to do.
_OTHERS: Mapping[str, tuple[str, str]] = {
    "Unclosed array": ("a list before it has no end", "close the list with ]"),
    "Cannot overwrite a value": ("its key or table is given twice", "keep one of the two"),
    "Unterminated string": ("a text has no end", 'close the text with "'),
    "Illegal character": ("a text has no end", 'close the text with "'),
}


def read_toml(path: Path, known: Sequence[str], named_by: str) -> tuple[TomlTable, str]:
    """Return a whole file as a table with these keys, and as text.

    Parameters
    ----------
    named_by : str
        Key or argument that names the file, for messages.

    Raises
    ------
    KgcpError
        If it is missing, not text, not TOML, or has an unknown key.
    """
    try:
        content = read_bytes(path, named_by, _MOST_BYTES)
        text = content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        likely = likely_encoding(content)
        raise KgcpError(
            f"{path}: is not UTF-8 but {likely}; save it as plain text in UTF-8"
        ) from error
    if _LONG_KEY.search(text):
        raise KgcpError(f"{path}: has a key of very many parts; delete it")
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem, remedy = _explained(text, str(error))
        raise KgcpError(f"{path}: is not TOML: {problem}; {remedy}") from error
    except (ValueError, RecursionError) as error:  # what tomllib makes of numbers and depth
        raise KgcpError(f"{path}: is not readable TOML ({error}); rewrite it") from error
    return TomlTable(f"{path}:", values, known), text


def _explained(text: str, message: str) -> tuple[str, str]:
    """Return what is wrong with a text that is not TOML, and what to do.

    Parameters
    ----------
    message : str
        Of `tomllib.TOMLDecodeError`.
    """
    place = _PLACE.search(message)
    number = None if place is None or place[1] is None else int(place[1])
    line = "" if number is None else text.splitlines()[number - 1].strip()
    where = "" if number is None else f"line {number}, '{_shortened(line)}'"
    if declared := _DECLARED_TWICE.search(message):
        name = declared[1]
        if name == "target":
            return f"line {number}: [target] is given twice", "head every target [[target]]"
        return f"line {number}: [{name}] is given twice", f"put all its keys under one [{name}]"
    for pattern, problem, remedy in _MISTAKES:
        if pattern.search(line):
            return f"{where} {problem}", remedy
    for words, (problem, remedy) in _OTHERS.items():
        if words in message:
            return f"{where}: {problem}" if where else problem, remedy
    return message, "correct that line: decimals take a point, texts quotes"


def _shortened(line: str) -> str:
    return line if len(line) <= _LONGEST_SHOWN else f"{line[: _LONGEST_SHOWN - 1]}…"
