"""Safe reading of files from elsewhere, which may be pipes, devices, far too large, or binary.

A file that a flight names is opened only if it is a regular file, or a link to one. It is read with
a limit, so that nothing can block the program or fill the memory.
"""

from __future__ import annotations

import codecs
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from kgcp.errors import KgcpError

MOST_BYTES = 1 << 29
"""Of a file that is read as a whole: a large reconstruction has a tenth of it."""
_LONGEST_LINE = 1 << 20  # characters
_HEAD = 4096  # bytes that tell an encoding
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
ARCHIVES = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"\x1f\x8b")
"""How spreadsheets (.xlsx and .ods, .xls) and archives (.zip, .gz) begin."""
_UNTOLD = 1 << 20  # bytes, where the system does not tell
_REFUSED_NAMES = {errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL}
LARGEST = 1e15
"""What no coordinate, angle, time or parameter reaches: more of it would overflow somewhere."""


def is_file(path: Path) -> bool:
    """Return whether this is a regular file; names that the system refuses are none."""
    return os.path.isfile(path)  # noqa: PTH113 - Path.is_file raises where a name is too long


def is_folder(path: Path) -> bool:
    """Return whether this is a folder; names that the system refuses are none."""
    return os.path.isdir(path)  # noqa: PTH112 - as above


def is_missing(path: Path) -> bool:
    """Return whether nothing has this name; names that the system refuses name nothing.

    It returns False also if the system cannot tell, as in a protected folder or on a network drive
    that is gone. Reading the file then says why.
    """
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return True
    except OSError as error:
        return error.errno in _REFUSED_NAMES
    return False


def is_no_file(path: Path) -> bool:
    """Return whether a name is known to be no regular file's; see `is_missing`."""
    return not is_file(path) and (os.path.lexists(path) or is_missing(path))


def is_sound(value: float) -> bool:
    """Return whether a number is finite and not absurd."""
    return abs(value) < LARGEST


def whole_number(value: float | str) -> int:
    """Return a number of things; `ValueError` if it has a fraction."""
    number = float(value)
    if number != int(number):
        raise ValueError(f"{number:g} is not a whole number")
    return int(number)


def is_number(text: str) -> bool:
    """Return whether this is the text of a sound number."""
    try:
        return is_sound(float(text))
    except ValueError:
        return False


def remedy_for_missing(path: Path, remedy: str) -> str:
    """Return what to do about a missing file: Notepad may have added `.txt` to its name."""
    added = Path(f"{path}.txt")
    return f"rename {added.name}, whose .txt Windows may hide" if is_file(added) else remedy


def require_file(path: Path, toml_key: str) -> None:
    """Refuse what is not a regular file.

    Raises
    ------
    KgcpError
        With the key of flight.toml that names it.
    """
    if is_file(path):
        return
    if not is_missing(path):
        try:
            path.stat()
        except OSError as error:
            raise unreadable(path, error, f"correct {toml_key}") from error
    problem = "is not a regular file" if os.path.lexists(path) else "does not exist"
    raise KgcpError(f"{path}: {problem}; flight.toml names it under {toml_key}")


def unreadable(path: Path, error: OSError, remedy: str) -> KgcpError:
    """Return the error of a file that cannot be read, to be raised."""
    if isinstance(error, PermissionError):
        return KgcpError(
            f"{path}: is protected, or open in another program; make it readable, or close it there"
        )
    return KgcpError(f"{path}: {error.strerror}; {remedy}")


def read_bytes(path: Path, toml_key: str, most: int = MOST_BYTES) -> bytes:
    """Return the content of a file of at most `most` bytes.

    Raises
    ------
    KgcpError
        If it is not a regular file, cannot be read or is larger.
    """
    require_file(path, toml_key)
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            room = min(size or _UNTOLD, most)  # which `read` takes at once, however little there is
            data = stream.read(room + 1) if size <= most else b""
    except OSError as error:
        raise unreadable(path, error, f"correct {toml_key}") from error
    if size > most or len(data) > room:
        raise KgcpError(
            f"{path}: has at least {max(size, len(data))} bytes, more than the {most} allowed for"
            f" {toml_key}; name the right file"
        )
    return data


def read_lines(path: Path, toml_key: str) -> Iterator[str]:
    """Yield the lines of a text in UTF-8, with their ends, as they are read.

    Raises
    ------
    KgcpError
        Naming the line: if it is not a regular file, cannot be read, or is not text.
    """
    require_file(path, toml_key)
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            yield from _bounded_lines(path, stream)
    except UnicodeDecodeError as error:
        with path.open("rb") as start:
            head = start.read(_HEAD)
        raise KgcpError(
            f"{path}: is not text in UTF-8 but {likely_encoding(head)}; {text_remedy(head)}"
        ) from error
    except OSError as error:
        raise unreadable(path, error, f"correct {toml_key}") from error


def likely_encoding(content: bytes) -> str:
    """Return in words the probable kind of a content that is not UTF-8."""
    if content.startswith(UTF_16):
        return "UTF-16"
    if content.startswith(ARCHIVES):
        return "a spreadsheet or archive"
    if b"\0" in content[:_HEAD]:
        return "a binary file"
    return "of another encoding (Latin-1 or Windows-1252?)"


def text_remedy(content: bytes) -> str:
    """Return what makes text in UTF-8 of a content that is not."""
    if content.startswith(ARCHIVES):
        return "export a spreadsheet as CSV, or unpack an archive"
    if b"\0" in content[:_HEAD] and not content.startswith(UTF_16):
        return "name a text file"
    return "save it as UTF-8"


def _bounded_lines(path: Path, stream: TextIO) -> Iterator[str]:
    number = 0
    while line := stream.readline(_LONGEST_LINE):
        number += 1
        if len(line) == _LONGEST_LINE or "\0" in line:
            raise KgcpError(
                f"{path}, line {number}: is not a valid text line (binary file?); name a text file"
            )
        yield line
