"""Two programs that write to the same folder."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.locks import open_locked, sole_writer


def test_one_run_of_a_command_writes_at_a_time(tmp_path: Path) -> None:
    folder = tmp_path / "results"
    with sole_writer(folder, "place"):
        with pytest.raises(KgcpError, match="results: another kgcp is writing here; wait"):
            sole_writer(folder, "place").__enter__()
        with sole_writer(folder, "orient"):
            pass
    with pytest.raises(LookupError), sole_writer(folder, "place"):
        raise LookupError
    with sole_writer(folder, "place"):
        pass
    assert not [*folder.iterdir()]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EACCES, "; make the folder writable, or choose another results folder"),
        (errno.ENOSPC, "; make room, then repeat the command"),
    ],
)
def test_a_lock_that_cannot_be_written_has_the_remedy_of_any_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, remedy: str
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(KgcpError, match=f"journal: .*{remedy}"):
        open_locked(tmp_path / "journal")
