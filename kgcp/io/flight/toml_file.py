"""A TOML file as a table whose keys are known."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.safe_read import likely_encoding, read_bytes
from kgcp.io.flight.toml_mistakes import explain_mistake
from kgcp.io.flight.toml_table import TomlTable

_MOST_BYTES = 1 << 18
# tomllib takes the square of the number of a key's parts.
_LONG_KEY = re.compile(
    r"""(?<![\w-])(?:(?:[\w-]++|"(?:[^"\\\n]|\\.){0,99}+"|'[^'\n]{0,99}+')[ \t]*+\.[ \t]*+){50}"""
)


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
        raise KgcpError(f"{path}: is not UTF-8 but {likely}; save it as UTF-8") from error
    if _LONG_KEY.search(text):
        raise KgcpError(f"{path}: has a key of very many parts; delete it")
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem, remedy = explain_mistake(text, str(error))
        raise KgcpError(f"{path}: is not TOML: {problem}; {remedy}") from error
    except (ValueError, RecursionError) as error:  # what tomllib makes of numbers and depth
        raise KgcpError(f"{path}: is not readable TOML ({error}); rewrite it") from error
    return TomlTable(f"{path}:", values, known), text
