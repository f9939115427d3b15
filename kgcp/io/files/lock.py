"""One process at a time may write certain files."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from kgcp.errors import KgcpError


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock that a file stands for; make its folder.

    The lock is the kernel's: it ends with the process that holds it, however that ends. The file
    that a killed process leaves behind locks nothing.

    Parameters
    ----------
    path : Path
        Of the file, which is made, has the holder's process number in it, and goes with the lock.

    Raises
    ------
    KgcpError
        If another process holds the lock, or the file cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _open_locked(path)
    except OSError as error:
        raise KgcpError(
            f"{path.parent}: cannot be written ({error}); choose another folder"
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):  # where the folder is gone; who has opened it looks again
            path.unlink()
        os.close(descriptor)


def _open_locked(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_same(descriptor, path):  # and not one that its holder has just deleted
                os.ftruncate(descriptor, 0)
                os.write(descriptor, b"%d\n" % os.getpid())
                return descriptor
        except BlockingIOError:
            holder = os.read(descriptor, 20).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise KgcpError(
                f"{path.parent}: another kgcp is writing here (process {holder}); wait for its"
                " end, or choose another folder"
            ) from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
