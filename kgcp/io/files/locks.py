"""Locks that keep several programs from writing the same results."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import FileIO
from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import unwritable
from kgcp.io.files.portable import OPEN_FLAGS, lock


def is_at(path: Path, file: FileIO) -> bool:
    """Return whether a path still leads to a file that is open."""
    return path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())


def open_locked(path: Path) -> FileIO:
    """Open a result for writing, created if needed, that no other process has open.

    The kernel holds the lock, and releases it when the process ends in whatever way.

    Raises
    ------
    KgcpError
        If another process has it open, or it cannot be written.
    """
    with _known_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        return _locked(path)


def _locked(path: Path) -> FileIO:
    if path.is_symlink():
        raise OSError(errno.ELOOP, "is a link; delete it")
    while True:
        flags = os.O_RDWR | os.O_CREAT | OPEN_FLAGS
        with ExitStack() as stack:
            file = stack.enter_context(FileIO(os.open(path, flags, 0o644), "r+"))
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise OSError(errno.EINVAL, "is not a file; delete it")
            lock(file.fileno())
            # another process may have deleted the file between opening and locking
            if is_at(path, file):
                stack.pop_all()
                return file


@contextmanager
def lock_file(path: Path) -> Iterator[None]:
    """Have a file of this name, locked against other processes, until the block ends.

    Raises
    ------
    BlockingIOError
        If another process has it.
    OSError
        If it cannot be written.
    """
    with _locked(path):
        try:
            yield
        finally:
            _delete(path)  # before its lock is released
    if os.name == "nt":
        _delete(path)


@contextmanager
def sole_writer(folder: Path, command: str) -> Iterator[None]:
    """Keep another run of a command from writing to the same folder until the block ends.

    Both would use the same temporary names, and leave some files of each.

    Raises
    ------
    KgcpError
        If another run is writing there, or the folder cannot be written.
    """
    path = folder / f".{command}.lock"
    with ExitStack() as stack:
        with _known_errors(path):
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_file(path))
        yield


@contextmanager
def _known_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except BlockingIOError as error:
        raise KgcpError(
            f"{path.parent}: another kgcp is writing here; wait until it ends, or choose another"
            " results folder",
            option="out",
        ) from error
    except OSError as error:
        raise unwritable(path, error) from error


def _delete(path: Path) -> None:
    """Delete a lock's file, unless another program has it open on Windows; it does no harm."""
    with suppress(OSError):
        path.unlink()
