"""The commands where the modules and calls of POSIX are missing, as on Windows."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import read_detections
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.pipeline.workspace import DETECTIONS

ROOT = Path(__file__).parents[2]
FRAMES = 2
# Python imports this at its start, in the program and in the processes that it starts.
AS_ON_WINDOWS = """
import errno, fcntl, os, signal, subprocess, sys, types  # subprocess asks for msvcrt, too

def locking(descriptor, mode, count):
    assert (mode, count) == (2, 1)
    assert os.lseek(descriptor, 0, os.SEEK_CUR) > 1 << 30
    try:
        fcntl_.flock(descriptor, fcntl_.LOCK_EX | fcntl_.LOCK_NB)
    except BlockingIOError:
        raise PermissionError(errno.EACCES, "Permission denied") from None

fcntl_ = fcntl
sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=locking)
for name in ("fcntl", "resource"):
    sys.modules[name] = None
for module, name in ((os, "memfd_create"), (os, "O_NOFOLLOW"), (os, "O_CLOEXEC"),
                     (signal, "pthread_sigmask"), (signal, "SIGALRM"), (signal, "SIG_BLOCK")):
    if hasattr(module, name):
        delattr(module, name)

import multiprocessing.forkserver  # which finds what is left of the others

context = multiprocessing.get_context
multiprocessing.get_context = lambda name=None: context("spawn" if name == "forkserver" else name)
multiprocessing.forkserver.ensure_running = lambda: None
"""


@pytest.fixture
def windows(tmp_path: Path) -> dict[str, str]:
    """The environment of a process that lacks what Windows lacks."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(AS_ON_WINDOWS, encoding="utf-8")
    paths = os.pathsep.join((str(tmp_path / "site"), str(ROOT)))
    # the code page of a redirected output, and Python's handling of missing characters
    return {**os.environ, "PYTHONPATH": paths, "PYTHONIOENCODING": "cp1252:surrogateescape"}


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """The first frames of the sample flight."""
    folder = tmp_path / "flight"
    shutil.copytree(ROOT / "sample_flight", folder, ignore=shutil.ignore_patterns("frames", "kgcp"))
    (folder / "frames").mkdir()
    for frame in sorted((ROOT / "sample_flight" / "frames").iterdir())[:FRAMES]:
        shutil.copy(frame, folder / "frames")
    return folder


def kgcp(environment: dict[str, str], *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        (sys.executable, "-m", "kgcp", *arguments),
        env=environment,
        capture_output=True,
        encoding="cp1252",
        check=False,
    )


def test_windows_gives_the_same_tables(
    windows: dict[str, str], flight: Path, tmp_path: Path
) -> None:
    run = kgcp(windows, "detect", str(flight), "--jobs", "2")
    assert run.returncode == 0, run.stderr
    out = flight / "kgcp"
    assert sorted(path.name for path in out.iterdir()) == ["detections.parquet", "run.json"]
    assert json.loads((out / "run.json").read_text("utf-8"))["peak_memory_mb"] == {}
    detect_flight(read_flight(flight), out=tmp_path / "here", options=RunOptions(jobs=0))
    there, here = (read_detections(folder / DETECTIONS) for folder in (out, tmp_path / "here"))
    assert len(there) == FRAMES
    assert there.equals(here)
    run = kgcp(windows, "export-gcp", str(flight), "--format", "csv")
    assert run.returncode == 0, run.stderr
    assert (out / "kgcps.parquet").exists()


def test_characters_missing_in_a_code_page_do_not_stop_a_command(
    windows: dict[str, str], flight: Path
) -> None:
    toml = flight / "flight.toml"
    toml.write_text(toml.read_text("utf-8").replace("-1.95", "1.95"), "utf-8")
    checked, helped = kgcp(windows, "check", str(flight)), kgcp(windows, "export-gcp", "--help")
    for run in (checked, helped):
        assert run.returncode == 0, run.stderr
        assert "?" not in run.stdout
    assert "lever arm puts the target 1.95 m below" in " ".join(checked.stdout.split())


def test_init_works_on_windows(windows: dict[str, str], flight: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare photos"
    shutil.copytree(flight / "frames", bare)
    shutil.copy(flight / "vehicle.csv", bare)
    run = kgcp(windows, "init", str(bare), "--lever-arm", "-0.8", "0.15", "-1.95")
    assert run.returncode == 0, run.stderr
    assert b"\r" not in (bare / "flight.toml").read_bytes()
    assert f'then kgcp check "{bare}"' in run.stderr


def test_a_second_run_at_the_same_time_is_refused(
    windows: dict[str, str], flight: Path, tmp_path: Path
) -> None:
    holder = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from kgcp.pipeline.execution.journal import Journal\n"
        "with Journal(Path(sys.argv[1]), {}, (), is_new=False):\n"
        "    print('held', flush=True)\n"
        "    sys.stdin.readline()\n"
    )
    out = tmp_path / "out"
    with subprocess.Popen(
        (sys.executable, "-c", holder, str(out / ".detections.journal")),
        env=windows,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "held\n"
        run = kgcp(windows, "detect", str(flight), "--out", str(out), "--jobs", "0")
        process.stdin.write("\n")
    assert run.returncode == 1
    assert "another kgcp is writing here" in run.stderr
