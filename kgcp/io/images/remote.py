"""Folders of object stores, `s3://…` and `gs://…`, through the file systems of Arrow."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

from kgcp.errors import KgcpError
from kgcp.io.files.portable import file_of
from kgcp.io.images.frames import frames_among, list_frames

if TYPE_CHECKING:
    from pyarrow.fs import FileInfo, FileSystem

_PAUSES_S = (1.0, 4.0, 16.0)  # before a read is repeated, in addition to Arrow's own attempts
_SCHEMES = ("s3", "gs", "gcs")


@dataclass(frozen=True, slots=True)
class StoredFolder:
    """A folder of an object store."""

    url: str  # as the user gave it: `s3://bucket/flights/7?region=eu-central-1`
    below: str = ""  # path below that, with `/`; empty: the folder itself

    def __truediv__(self, name: str) -> StoredFolder:
        """Return the object or folder of this name in the folder."""
        return replace(self, below=f"{self.below}/{name}".strip("/"))

    def __str__(self) -> str:
        """Return the URL without keys and options, which must not appear in messages."""
        parts = urlsplit(self.url)
        place = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}".rstrip("/")
        return f"{place}/{self.below}" if self.below else place

    @property
    def name(self) -> str:
        """Last part of the path."""
        return str(self).rpartition("/")[2]

    def files(self, *, is_deep: bool) -> list[tuple[str, FileInfo]]:
        """List the files and folders in the folder, or with `is_deep` all files below it.

        Names are relative to the folder.

        Raises
        ------
        KgcpError
            If it does not exist or cannot be read, or a name leads out of it.
        """
        from pyarrow.fs import FileSelector, FileType

        system, path = self._opened()
        with self._reported():
            infos = system.get_file_info(FileSelector(path, recursive=is_deep))
        named = [(info.path[len(path) :].strip("/"), info) for info in infos]
        for name, _ in named:
            if {"", ".", ".."} & set(name.split("/")) or "\\" in name:
                raise KgcpError(
                    f"{self}: the name {name!r} is not a path below it; rename the object"
                )
        return [each for each in named if not is_deep or each[1].type == FileType.File]

    def tree(self, passed_over: Sequence[str]) -> Iterator[str]:
        """Yield the files below the folder: names relative to it.

        Hidden files and the folders `passed_over` are left out. S3 does not even list these; in
        `gs://` Arrow sees no folder that it does not list. Raises as `files`.
        """
        left_out = [f"{each}/" for each in passed_over]
        folders = [""]
        for folder in folders:
            for name, info in (self / folder).files(is_deep=self.url.startswith("g")):
                path = f"{folder}/{name}".lstrip("/")
                if "/." in f"/{path}" or any(map(f"{path}/".startswith, left_out)):
                    continue
                if info.is_file:
                    yield path
                else:
                    folders.append(path)

    def read(self) -> bytes:
        """Return the content of an object.

        Raises
        ------
        KgcpError
            If it does not exist or cannot be read.
        """
        system, path = self._opened()
        for pause_s in _PAUSES_S:
            try:
                return _content(system, path)
            except FileNotFoundError:
                break
            except OSError:
                time.sleep(pause_s)
        with self._reported():
            return _content(system, path)

    def write(self, source: Path) -> None:
        """Write a file here, which appears as a whole.

        Raises
        ------
        KgcpError
            If it cannot be written.
        """
        import pyarrow as pa

        system, path = self._opened()
        with (
            self._reported("cannot be written"),
            pa.memory_map(str(source)) as content,
            system.open_output_stream(path) as stream,
        ):
            # In one piece: a stream that ends early would leave an object with half of the file.
            stream.write(content.read_buffer())

    def require_writable(self) -> None:
        """Write and delete an object, to fail before hours of work instead of after.

        Raises
        ------
        KgcpError
            If either fails.
        """
        system, path = (self / ".kgcp")._opened()
        with self._reported("cannot be written"):
            with system.open_output_stream(path) as stream:
                stream.write(b"kgcp")
            system.delete_file(path)

    def has(self, name: str) -> bool:
        """Return whether there is a file of this name.

        Raises
        ------
        KgcpError
            If the store does not answer.
        """
        system, path = (self / name)._opened()
        with self._reported():
            return bool(system.get_file_info(path).is_file)

    def _opened(self) -> tuple[FileSystem, str]:
        system, base = _system(self.url)
        return system, f"{base}/{self.below}".rstrip("/")

    @contextmanager
    def _reported(self, problem: str = "cannot be read") -> Iterator[None]:
        try:
            yield
        except FileNotFoundError as error:
            raise KgcpError(
                f"{self}: does not exist; correct the URL, or put it there and repeat the command"
            ) from error
        except OSError as error:
            raise KgcpError(
                f"{self}: {problem} ({_line(error)}); check URL, keys and network, and repeat the"
                " command"
            ) from error


def parsed_url(text: str) -> Path | StoredFolder:
    """Return the path or the stored folder that a text names; `file://` URLs are paths.

    Raises
    ------
    KgcpError
        If the location is not supported.
    """
    if "://" not in text:
        return Path(text)
    parts = urlsplit(text)
    if parts.scheme == "file":
        # a share of another computer, as Windows names it
        host = "" if parts.netloc in {"", "localhost"} else f"//{parts.netloc}"
        return Path(url2pathname(host + parts.path))
    if len(parts.scheme) == 1:  # the letter of a drive
        return Path(text)
    if parts.scheme not in _SCHEMES or not parts.netloc:
        raise KgcpError(
            f"{text}: unsupported location; use a folder, s3://bucket/folder or gs://bucket/folder"
        )
    return StoredFolder(text)


def frames_below(folder: Path | StoredFolder) -> list[str]:
    """List the images below a folder, by the rules of `kgcp.io.images.frames.list_frames`.

    Raises
    ------
    KgcpError
        As `list_frames`, and if the store cannot be read.
    """
    if isinstance(folder, Path):
        return list_frames(folder)
    return frames_among([name for name, _ in folder.files(is_deep=True)], str(folder))


def stamps_of(
    folder: Path | StoredFolder, names: Sequence[str]
) -> Iterator[tuple[int, int] | None]:
    """Yield sizes and modification times [ns] of files, which show changes; None: missing.

    Raises
    ------
    KgcpError
        If a store cannot be read.
    """
    if isinstance(folder, Path):
        yield from (_stamp(folder / name) for name in names)
        return
    infos: Mapping[str, Any] = dict(folder.files(is_deep=True))
    for name in names:
        info = infos.get(name)
        yield None if info is None else (info.size, info.mtime_ns or 0)


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


@contextmanager
def at_hand(folder: Path | StoredFolder, name: str) -> Iterator[Path]:
    """Provide the path of a file that can be opened, until the block ends.

    On Linux, an object's content is kept in memory and not written to a disk.

    Raises
    ------
    KgcpError
        If an object cannot be read; that is not a `Rejection` of the frame.
    """
    if isinstance(folder, Path):
        yield folder / name
        return
    with file_of((folder / name).read()) as path:
        yield path


@cache
def _system(url: str) -> tuple[FileSystem, str]:
    """Open a store, once in a process."""
    from pyarrow import ArrowInvalid
    from pyarrow.fs import FileSystem

    try:
        system, path = FileSystem.from_uri(url)
    except (ArrowInvalid, OSError, NotImplementedError) as error:
        raise KgcpError(f"{StoredFolder(url)}: {_line(error)}; correct the URL") from error
    return system, path.rstrip("/")


def _content(system: FileSystem, path: str) -> bytes:
    with system.open_input_file(path) as stream:
        if stream.closed:  # a stream of gs:// that has failed already
            raise OSError("the store has closed the stream")
        content: bytes = stream.read()
    return content


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
