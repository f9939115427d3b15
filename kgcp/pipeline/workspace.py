"""Working folders of a command: the flight's own, or copies if it is in an object store."""

from __future__ import annotations

import hashlib
import os
import tempfile
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.io.files.safe_read import is_missing
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frames import FRAME_SUFFIXES, RESULTS_NAME
from kgcp.io.images.remote import StoredFolder

DETECTIONS = "detections.parquet"
"""File name of the detections, which `kgcp detect` writes and other commands read."""


def results_folder(flight: Path) -> Path:
    """Return the default folder of a flight's results.

    A flight's folder may come from anybody. If the results' folder or a folder in it is a link,
    files would be written wherever it leads. Such links are refused.

    Raises
    ------
    KgcpError
        If there is such a link.
    """
    folder = flight / RESULTS_NAME
    if os.path.islink(folder):  # noqa: PTH114 - Path.is_symlink raises in a protected folder
        raise KgcpError(
            f"{folder}: is a link; delete it, or use its destination as the results folder",
            option="out",
        )
    for parent, folders, _ in os.walk(folder):
        for name in folders:
            path = Path(parent) / name
            if path.is_symlink():
                raise KgcpError(
                    f"{path}: is a link to a folder; delete it, or choose another results folder",
                    option="out",
                )
    return folder


def require_outside_frames(flight: Flight, folder: Path, usual: str, *, option: str) -> None:
    """Refuse a folder of pictures in which these would be taken for frames.

    Parameters
    ----------
    usual : str
        Name of a folder in the results' one that suits, for the message.

    Raises
    ------
    KgcpError
        If it is among the frames, and not in the flight's results folder.
    """
    place = folder.resolve()
    is_result = place.is_relative_to((flight.folder / RESULTS_NAME).resolve())
    if place.is_relative_to(flight.frames_folder.resolve()) and not is_result:
        raise KgcpError(
            f"{folder}: is among the frames, where pictures would be taken for frames;"
            f" choose another folder of pictures, such as {flight.folder / RESULTS_NAME / usual}",
            option=option,
        )


@dataclass(frozen=True, slots=True)
class Workspace:
    """Folders of this machine, and the places in a store that they replace."""

    flight: Path  # with flight.toml and the files that it names, without frames of a stored flight
    out: Path  # for the results
    # places in a store that `flight` and `out` replace; None: they are the user's own folders
    stored_flight: StoredFolder | None
    stored_out: StoredFolder | None

    def frames_of(self, flight: Flight) -> StoredFolder | None:
        """Return where the frames are; None: in the flight's folder of frames."""
        if self.stored_flight is None:
            return None
        return self.stored_flight / flight.frames_folder.relative_to(self.flight).as_posix()

    def detections(self, named: Path | None) -> Path:
        """Return the table of detections: the named one, or that in the results' folder.

        Raises
        ------
        KgcpError
            If it is not there, but in the folder in which results usually are.
        """
        table, usual = self.out / DETECTIONS, self.flight / RESULTS_NAME / DETECTIONS
        if named is None and is_missing(table) and not is_missing(usual):
            raise KgcpError(
                f"{table}: does not exist; name the table that lies in the flight's folder",
                option=f"detections {usual}",
            )
        return named or table

    def named(self, text: object) -> str:
        """Return a path, or a text with paths, by the names that the user knows."""
        shown = str(text)
        for folder, stored in ((self.out, self.stored_out), (self.flight, self.stored_flight)):
            if stored is not None:
                shown = shown.replace(str(folder), str(stored))
        return shown


@contextmanager
def open_workspace(
    flight: Path | StoredFolder, out: Path | StoredFolder | None, needs: Sequence[str] = ()
) -> Iterator[Workspace]:
    """Provide working folders until the block ends, and then store the results.

    Parameters
    ----------
    out : Path, StoredFolder or None
        None: the folder `kgcp` in the flight's.
    needs : sequence of str
        Results of other commands, that must be at hand in `out` if they are there.

    Raises
    ------
    KgcpError
        If a store cannot be read or written. Those of the block name what the user knows.
    """
    with ExitStack() as stack:
        stored_flight = None
        if isinstance(flight, StoredFolder):
            temporary = stack.enter_context(tempfile.TemporaryDirectory(prefix="kgcp-"))
            where, stored_flight = _copied(flight, Path(temporary) / flight.name), flight
        else:
            where = flight
        results = out or _results_of(flight)
        stored_out = results if isinstance(results, StoredFolder) else None
        workspace = Workspace(
            where,
            results if isinstance(results, Path) else _cache_of(results),
            stored_flight,
            stored_out,
        )
        fetched = [] if stored_out is None else _fetched(stored_out, workspace.out, needs)
        try:
            yield workspace
        except KgcpError as error:
            raise KgcpError(workspace.named(error), option=error.option) from error
        if stored_out is not None:
            _deliver(workspace.out, stored_out, fetched)


def _results_of(flight: Path | StoredFolder) -> Path | StoredFolder:
    return flight / RESULTS_NAME if isinstance(flight, StoredFolder) else results_folder(flight)


def _copied(flight: StoredFolder, folder: Path) -> Path:
    """Copy a flight without its frames, and make their folder."""
    folder.mkdir()
    (folder / "flight.toml").write_bytes((flight / "flight.toml").read())
    frames = _frames_folder(folder / "flight.toml")
    if frames is not None:
        (folder / frames).mkdir(parents=True, exist_ok=True)
    for name in flight.tree([RESULTS_NAME] if frames is None else [RESULTS_NAME, str(frames)]):
        if PurePosixPath(name).suffix.lower() not in FRAME_SUFFIXES:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes((flight / name).read())
    return folder


def _frames_folder(path: Path) -> PurePosixPath | None:
    """Return the folder of the frames, if it is one below the flight's; who reads it all says."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig")).get("frames", {})
        name = PurePosixPath(table.get("folder", "frames"))
    except (ValueError, RecursionError, AttributeError, TypeError):
        return None
    return None if name.is_absolute() or ".." in name.parts else name


def _cache_of(out: StoredFolder) -> Path:
    """Return the folder of this machine in which results of a store are made.

    It is the same for every run, so that the journal of one that was interrupted is found again.

    Raises
    ------
    KgcpError
        If the user has no home, as in some containers.
    """
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError as error:
        raise KgcpError(
            "the user has no home folder; set XDG_CACHE_HOME to a folder with space for the results"
        ) from error
    return base / "kgcp" / hashlib.sha256(str(out).encode()).hexdigest()[:16]


def _fetched(out: StoredFolder, folder: Path, needs: Sequence[str]) -> list[Path]:
    """Have the named results of other commands at hand, where there are any."""
    out.require_writable()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = [name for name in needs if out.has(name)]
        for name in found:
            (folder / name).write_bytes((out / name).read())
    except OSError as error:
        raise KgcpError(
            f"{folder}: cannot be written ({error.strerror}); set XDG_CACHE_HOME to a folder with"
            " space for the results"
        ) from error
    return [folder / name for name in found]


def _deliver(folder: Path, out: StoredFolder, fetched: Sequence[Path]) -> None:
    """Put all results into a store, in the order in which they were made, and delete them here."""
    results = [
        path
        for path in folder.rglob("*")
        if path.is_file()
        and path not in fetched
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    try:
        for path in sorted(results, key=lambda path: (path.stat().st_mtime_ns, path)):
            (out / path.relative_to(folder).as_posix()).write(path)
    except KgcpError as error:
        raise KgcpError(f"{error} (the results are in {folder}: copy them by hand)") from error
    except BaseException:  # interrupted: the journal is gone, so that nothing would be resumed
        warnings.warn(
            f"{out}: does not have all results yet; they are in {folder}: copy them by hand",
            KgcpWarning,
            stacklevel=2,
        )
        raise
    for path in (*results, *fetched):
        path.unlink()
    folders = [path for path in folder.rglob("*") if path.is_dir() and path.name[0] != "."]
    for path in (*sorted(folders, reverse=True), folder):
        with suppress(OSError):  # it has the journal of a run that was interrupted
            path.rmdir()
