"""Output streams whose encoding lacks some of kgcp's characters, as on Windows' code pages."""

from __future__ import annotations

import codecs
import io
import unicodedata
from typing import TextIO

# Characters that have no decomposition into ASCII, and what takes their place.
_ASCII = str.maketrans(
    {
        "−": "-",
        "–": "-",
        "→": "->",
        "←": "<-",
        "≥": ">=",
        "≤": "<=",
        "≈": "~",
        "×": "x",
        "±": "+-",
        "·": "*",
        "√": "sqrt ",
        "σ": "sigma",
        "χ": "chi",
        "δ": "delta",
        "Δ": "delta ",
        "µ": "u",
        "°": " deg",
        "‰": " per mille",
    }
)
_HANDLER = "kgcp.ascii"
_PYTHONS_HANDLERS = ("strict", "surrogateescape", "backslashreplace")


def print_anything(*streams: TextIO) -> None:
    """Let streams print characters that their encoding lacks as similar ASCII ones.

    Output that is redirected has such an encoding on Windows. Without this, a minus sign would end
    the command.
    """
    codecs.register_error(_HANDLER, _as_ascii)
    for stream in streams:
        # Python's own choices: the second is that of output on Windows, the third of errors
        if isinstance(stream, io.TextIOWrapper) and stream.errors in _PYTHONS_HANDLERS:
            stream.reconfigure(errors=_HANDLER)


def _as_ascii(error: UnicodeError) -> tuple[str, int]:
    """Return what is printed for the characters that cannot be encoded, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end].translate(_ASCII)
    letters = unicodedata.normalize("NFKD", lacking)  # accents are separate characters there
    base = (letter for letter in letters if not unicodedata.combining(letter))
    return "".join(letter if letter.isascii() else "?" for letter in base), error.end
