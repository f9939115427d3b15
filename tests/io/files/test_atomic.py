from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.atomic import whole_file, write_all, write_bytes


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    for content in (b"first", b"2"):
        write_bytes(path, content)
        assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]


def test_a_rename_that_fails_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.txt" / "occupied").mkdir(parents=True)
    with pytest.raises(
        KgcpError, match=r"a\.txt: cannot be written .*; choose another results folder"
    ):
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


def test_a_link_in_the_way_is_not_followed(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_bytes(b"precious")
    (tmp_path / ".a.txt.part").symlink_to(elsewhere)
    write_bytes(tmp_path / "a.txt", b"content")
    assert elsewhere.read_bytes() == b"precious"
    assert (tmp_path / "a.txt").read_bytes() == b"content"


def test_many_files_are_written_or_the_one_that_cannot_be_is_named(tmp_path: Path) -> None:
    contents = {tmp_path / "many" / f"{number}.txt": b"%d" % number for number in range(50)}
    write_all(contents)
    assert {path: path.read_bytes() for path in (tmp_path / "many").iterdir()} == contents
    (tmp_path / "7.txt" / "occupied").mkdir(parents=True)
    with pytest.raises(KgcpError, match=r"7\.txt: cannot be written"):
        write_all({tmp_path / f"{number}.txt": b"" for number in range(9)})
    assert not [*tmp_path.glob(".*.part")]
