"""What differs between Windows, Linux and macOS, each behind one function.

The modules of either system are imported by their names, so that a type checker for the other one
does not look into them.
"""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

OPEN_FLAGS: int = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_CLOEXEC", "O_BINARY"))
"""For `os.open`, as far as the system has them: no links, not for child processes, no new lines."""
# Byte that Windows locks, beyond all that is written, which stays readable. C libraries may take
# its position for a number of 32 bits.
_BEYOND = (1 << 31) - 2
_BYTES_PER_KB = 1024
_PAUSES_S = (0.05, 0.1, 0.2, 0.4, 0.8)  # before what Windows has refused is tried again


def _module(name: str) -> Any:  # noqa: ANN401 - a module of one system, with its own attributes
    """Return a module of the standard library; None where the system has none of this name."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        return None


def lock(descriptor: int) -> None:
    """Lock an open file against other processes; the lock ends with the process or the file.

    Raises
    ------
    BlockingIOError
        If another process has it.
    """
    fcntl = _module("fcntl")
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    msvcrt = _module("msvcrt")
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    os.lseek(descriptor, _BEYOND, os.SEEK_SET)
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except PermissionError as error:  # any other error: the drive has no locks
        raise BlockingIOError(errno.EAGAIN, error.strerror) from error
    finally:
        os.lseek(descriptor, position, os.SEEK_SET)


def replace(source: Path, target: Path) -> None:
    """Rename a file or folder, to a name that another file may have.

    Windows refuses that while a program has one of the two open; scanners of viruses have new files
    open for a moment.

    Raises
    ------
    OSError
        `PermissionError` if one of them stays open, or is protected.
    """
    for pause_s in _PAUSES_S:
        try:
            source.replace(target)
        except PermissionError:
            time.sleep(pause_s)
        else:
            return
    source.replace(target)


def peak_memory_mb() -> dict[str, float]:
    """Return the largest memory [MB] of this process and of one that it has waited for.

    It is empty where the system does not say. The kernel counts for a process also what its parent
    had when it was started.
    """
    resource = _module("resource")
    if resource is None:
        return {}
    who = {"parent": resource.RUSAGE_SELF, "largest_worker": resource.RUSAGE_CHILDREN}
    # macOS counts bytes, Linux kilobytes
    unit = _BYTES_PER_KB**2 if sys.platform == "darwin" else _BYTES_PER_KB
    return {name: resource.getrusage(each).ru_maxrss / unit for name, each in who.items()}


def raised_limit_of_open_files(needed: int) -> int:
    """Let this process have more files open, if the system permits it; return the limit.

    macOS allows 256 unless a process asks for more. Windows has no such limit.
    """
    resource = _module("resource")
    if resource is None:
        return needed
    allowed, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if allowed == resource.RLIM_INFINITY:
        return needed
    if allowed < needed:
        with suppress(OSError, ValueError):  # beyond `most`, or what the kernel allows
            resource.setrlimit(resource.RLIMIT_NOFILE, (needed, most))
            return needed
    return int(allowed)


def scratch_file() -> IO[bytes]:
    """Open a nameless file: in memory on Linux, where full disks and lost folders do no harm."""
    create: Any = getattr(os, "memfd_create", None)
    return tempfile.TemporaryFile() if create is None else os.fdopen(create("scratch"), "w+b")


@contextmanager
def file_of(content: bytes) -> Iterator[Path]:
    """Have bytes as a file until the block ends: in memory on Linux, else in a temporary folder."""
    create: Any = getattr(os, "memfd_create", None)
    if create is None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frame"
            path.write_bytes(content)
            yield path
        return
    descriptor = create("frame")
    try:
        with os.fdopen(descriptor, "wb", closefd=False) as stream:
            stream.write(content)
        yield Path(f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)
