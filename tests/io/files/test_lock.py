from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.files.lock import locked

HOLD = (
    "import sys, time; from pathlib import Path; from kgcp.io.files.lock import locked\n"
    "with locked(Path(sys.argv[1])):\n"
    "    print('held', flush=True)\n"
    "    time.sleep(300)\n"
)


def test_a_lock_is_one_process_s_until_it_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "out" / ".lock"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        text = rf"out: another kgcp is writing here \(process {holder.pid}\); wait"
        with pytest.raises(KgcpError, match=text), locked(path):
            pass
        holder.kill()
    assert path.exists(), "what the killed one left"
    time.sleep(0.1)
    with locked(path):
        pass
    assert not path.exists()


def test_a_lock_is_free_again_after_an_error(tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(ZeroDivisionError), locked(tmp_path / "lock"):
            raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_a_lock_is_held_within_a_process_too(tmp_path: Path) -> None:
    with locked(tmp_path / "lock"), pytest.raises(KgcpError), locked(tmp_path / "lock"):
        pass


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_lock_that_cannot_be_made_is_a_line(kind: str, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("precious", encoding="utf-8")
    out = tmp_path / "out"
    if kind == "file":
        out.touch()
    else:
        out.mkdir()
        (out / "lock").symlink_to(elsewhere)
    text = r"out: cannot be written .*; choose another folder"
    with pytest.raises(KgcpError, match=text), locked(out / "lock"):
        pass
    assert elsewhere.read_text(encoding="utf-8") == "precious"
