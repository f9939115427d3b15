from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import remove, unwritable, whole_file, write_all, write_bytes
from tests.systems import needs_links


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    for content in (b"first", b"2"):
        write_bytes(path, content)
        assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]


def test_a_rename_that_fails_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.txt" / "occupied").mkdir(parents=True)
    with pytest.raises(KgcpError, match=r"a\.txt: is a folder, .*; rename the folder"):
        write_bytes(tmp_path / "a.txt", b"content")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_an_interrupt_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_bytes(path, b"old")
    with pytest.raises(KeyboardInterrupt), whole_file(path) as temporary:  # noqa: PT012 - in it
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == b"old"


@needs_links
def test_a_link_in_the_way_is_not_followed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(b"precious")
    (tmp_path / ".a.txt.part").symlink_to(elsewhere)
    write_bytes(tmp_path / "a.txt", b"content")
    assert elsewhere.read_bytes() == b"precious"
    assert (tmp_path / "a.txt").read_bytes() == b"content"


def test_a_full_disk_asks_for_room_and_not_for_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(KgcpError, match=r"a\.txt: no space left; make room, then repeat") as caught:
        write_bytes(tmp_path / "a.txt", b"content")
    assert caught.value.option is None
    assert not any(tmp_path.iterdir())


def test_many_files_are_written_or_the_one_that_cannot_be_is_named(tmp_path: Path) -> None:
    contents = {tmp_path / "many" / f"{number}.txt": b"%d" % number for number in range(50)}
    write_all(contents)
    assert {path: path.read_bytes() for path in (tmp_path / "many").iterdir()} == contents
    (tmp_path / "7.txt" / "occupied").mkdir(parents=True)
    with pytest.raises(KgcpError, match=r"7\.txt: is a folder"):
        write_all({tmp_path / f"{number}.txt": b"" for number in range(9)})
    assert not [*tmp_path.glob(".*.part")]


class OpenFile:
    """A file that Windows keeps while a program has it open, for this many attempts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, path: Path, attempts: float) -> None:
        self.path, self.attempts = path, attempts
        monkeypatch.setattr("kgcp.io.files.portable.time.sleep", lambda _: None)
        for name, is_its_own in (("unlink", True), ("replace", False)):
            self._refuse(monkeypatch, name, getattr(Path, name), is_its_own=is_its_own)

    def _refuse(
        self,
        monkeypatch: pytest.MonkeyPatch,
        name: str,
        does: Callable[..., object],
        *,
        is_its_own: bool,
    ) -> None:
        def refused(path: Path, *args: Path, **options: bool) -> object:
            touched = path if is_its_own else args[0]
            if touched == self.path and self.path.exists():
                self.attempts -= 1
                if self.attempts >= 0:
                    raise PermissionError(13, "Access is denied", str(touched))
            return does(path, *args, **options)

        monkeypatch.setattr(Path, name, refused)


def test_a_file_that_is_open_elsewhere_is_reported_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kgcps.csv"
    write_bytes(path, b"old")
    OpenFile(monkeypatch, path, float("inf"))
    text = r"kgcps\.csv: is open in another program, or protected; close it there, then repeat"
    with pytest.raises(KgcpError, match=text):
        write_bytes(path, b"new")
    with pytest.raises(KgcpError, match=text):
        remove(path)
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [(path.name, b"old")]


def test_a_file_that_is_open_for_a_moment_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kgcps.csv"
    write_bytes(path, b"old")
    OpenFile(monkeypatch, path, 2)
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new"


def test_what_cannot_be_deleted_is_reported(tmp_path: Path) -> None:
    remove(tmp_path / "not there")
    (tmp_path / "a").mkdir()
    with pytest.raises(KgcpError, match=r"a: is a folder"):
        remove(tmp_path / "a")


def test_a_protected_folder_is_to_be_made_writable() -> None:
    error = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    text = str(unwritable(Path("t.parquet"), error))
    assert text.endswith("; make the folder writable, or choose another results folder")
