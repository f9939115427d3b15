"""What Windows does in another way."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from kgcp.io.files.portable import lock


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.EACCES, BlockingIOError), (errno.EINVAL, OSError)]
)
def test_a_drive_without_locks_is_not_taken_for_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[OSError]
) -> None:
    def locking(*_: int) -> None:
        raise OSError(number, "refused")

    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(LK_NBLCK=2, locking=locking))
    with (tmp_path / "journal").open("wb") as stream:
        with pytest.raises(OSError, match="refused") as caught:
            lock(stream.fileno())
        assert type(caught.value) is kind
        assert stream.tell() == 0
