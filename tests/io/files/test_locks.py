"""Two programs that write to the same folder."""

from __future__ import annotations

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


def test_a_protected_file_is_to_be_made_writable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.open", refuse)
    text = r"journal: cannot be written \(Permission denied\); make it writable, or choose another"
    with pytest.raises(KgcpError, match=text):
        open_locked(tmp_path / "journal")
