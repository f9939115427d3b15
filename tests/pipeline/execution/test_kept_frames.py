"""Frames kept between two looks: exactly, within their room, and not for longer than the run."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from kgcp.geometry.arrays import GreyArray
from kgcp.pipeline.execution.kept_frames import KeptFrames, kept_frames


@pytest.mark.parametrize("grey", [np.ones((3, 4), np.uint8), np.ones((3, 4), np.uint16)])
def test_a_frame_comes_back_as_it_was(tmp_path: Path, grey: GreyArray) -> None:
    kept = KeptFrames(tmp_path, 1000)
    kept.keep("a/b.png", grey)
    found = kept.find("a/b.png")
    assert found is not None
    assert found.dtype == grey.dtype
    assert np.array_equal(found, grey)
    assert kept.find("b.png") is None


def test_no_more_are_kept_than_there_is_room_for_whoever_keeps_them(tmp_path: Path) -> None:
    looking_here, looking_there = KeptFrames(tmp_path, 25), KeptFrames(tmp_path, 25)
    for kept, name in zip((looking_here, looking_there, looking_here), "abc", strict=True):
        kept.keep(name, np.zeros((3, 4), np.uint8))
    assert [looking_there.find(name) is not None for name in "abc"] == [True, True, False]
    assert len([path for path in tmp_path.iterdir() if path.stat().st_size >= 12]) == 2


def test_what_is_no_kept_frame_is_not_taken_for_one(tmp_path: Path) -> None:
    kept = KeptFrames(tmp_path, 1000)
    kept.keep("a", np.zeros((3, 4), np.uint8))
    path = max(tmp_path.iterdir(), key=lambda path: path.stat().st_size)
    path.write_bytes(path.read_bytes()[:-1])
    assert kept.find("a") is None


def test_the_folder_is_new_and_goes_with_the_run(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    (folder / "left by a killed run").touch()
    with kept_frames(folder) as kept:
        assert kept is not None
        assert not [*folder.iterdir()]
        kept.keep("a", np.zeros((3, 4), np.uint8))
        assert kept.find("a") is not None
    assert not folder.exists()


def test_where_no_folder_can_be_nothing_is_kept(tmp_path: Path) -> None:
    (tmp_path / "frames").touch()
    with kept_frames(tmp_path / "frames") as kept:
        assert kept is None


def test_a_full_disk_gets_back_what_was_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with kept_frames(tmp_path / "frames") as kept:
        assert kept is not None
        kept.keep("a", np.zeros((3, 4), np.uint8))

        def refused(*_: object, **__: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(np.lib.format, "write_array", refused)
        kept.keep("b", np.zeros((3, 4), np.uint8))
        assert kept.find("a") is None
        assert not (tmp_path / "frames").exists()


def test_a_scanner_that_opens_new_files_does_not_end_all_keeping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename, refusals = Path.replace, iter([True])

    def refused_once(path: Path, target: Path) -> Path:
        if next(refusals, False):
            raise PermissionError(errno.EACCES, "Access is denied")
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", refused_once)
    kept = KeptFrames(tmp_path, 1000)
    kept.keep("a", np.zeros((3, 4), np.uint8))
    assert kept.find("a") is not None
