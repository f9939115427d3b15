"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.portable import replace

_WRITERS = 8  # at a time: a disk confirms several files as quickly as one


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name in the folder of `path`; rename it at the end.

    The content is flushed to the disk before the rename, so that not even a power failure leaves
    half a file. If anything is raised, the temporary file is deleted.

    Raises
    ------
    KgcpError
        If a folder has the name, or a file that is open in another program, on Windows.
    OSError
        If the file does not exist at the end, or cannot be renamed.
    """
    temporary = path.with_name(f".{path.name}.part")
    with suppress(FileNotFoundError):
        temporary.unlink()  # of a run that was killed, or a link to another place
    try:
        yield temporary
        with temporary.open("r+b") as written:  # Windows flushes only what may be written
            os.fsync(written.fileno())
        try:
            replace(temporary, path)
        except (IsADirectoryError, PermissionError) as error:
            raise _refused(path) from error
    except BaseException:
        with suppress(OSError):  # it may not exist, or its folder be gone
            temporary.unlink()
        raise


def remove(path: Path) -> None:
    """Delete a file if it is there.

    Raises
    ------
    KgcpError
        If it cannot be deleted.
    """
    try:
        path.unlink(missing_ok=True)
    except (IsADirectoryError, PermissionError) as error:
        raise _refused(path) from error
    except OSError as error:
        raise KgcpError(f"{path}: cannot be deleted ({error.strerror}); delete it") from error


def _refused(path: Path) -> KgcpError:
    """Return the error of a file that may not be replaced or deleted."""
    if path.is_dir():
        return KgcpError(f"{path}: is a folder, kgcp needs this name for a file; rename the folder")
    return KgcpError(
        f"{path}: is open in another program, or protected; close it there, then repeat the command"
    )


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file by a temporary name in the same folder and a rename; make the folder.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise unwritable(path, error) from error


def unwritable(path: Path, error: OSError) -> KgcpError:
    """Return the error of a result that cannot be written.

    An interrupted run can only be resumed in its results folder: another one is not the remedy for
    a full disk, and the second one for a protected folder.
    """
    if error.errno in {errno.ENOSPC, errno.EDQUOT}:
        return KgcpError(f"{path}: no space left; make room, then repeat the command")
    remedy = "make the folder writable, or " if isinstance(error, PermissionError) else ""
    return KgcpError(
        f"{path}: cannot be written ({error.strerror or error}); {remedy}choose another results"
        " folder",
        option="out",
    )


def write_all(contents: Mapping[Path, bytes]) -> None:
    """Write files, each as `write_bytes` does.

    Raises
    ------
    KgcpError
        If one of them cannot be written.
    """
    with ThreadPoolExecutor(_WRITERS) as pool:
        for _ in pool.map(write_bytes, contents, contents.values()):
            pass
