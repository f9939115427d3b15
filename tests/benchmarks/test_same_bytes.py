"""The same bytes, for any number of threads and jobs, also if numpy was loaded before.

`python -m benchmarks.reliability.same_bytes` has more circumstances: what is compiled when, and by
whom.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.reliability.same_bytes import Circumstances, file_hashes, make_flight, process

# in one process, which imports once; by default, more frames would be exposed again
_ALL_COMMANDS = """\
import sys
if "{is_library_call}" == "True":
    import numpy
    square = numpy.ones((600, 600))
    square @ square  # the library has its threads before kgcp is there
from kgcp.cli import main
if __name__ == "__main__":
    detect = ("detect", "--jobs", "{jobs}", "--quiet")
    for command in (detect, ("export-gcp", "--format", "all"), ("bias-report", "--reexpose", "1")):
        main([*command, "{flight}", "--out", "{out}"], standalone_mode=False)
"""


def circumstances(core: str | None) -> Iterator[Circumstances]:
    """Some of `one_machine`, for the kernels of this processor or of an old one."""
    chosen = {} if core is None else {"OPENBLAS_CORETYPE": core}
    one, four = (
        {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, **chosen}
        for threads in ("1", "4")
    )
    yield Circumstances("one thread", 0, one)
    jobs = 2 if core is None else 0
    yield Circumstances(
        f"four threads, {jobs} jobs, in a program that has used numpy",
        jobs,
        four,
        is_library_call=True,
    )


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("same_bytes") / "flight"
    make_flight(folder, 4)
    return folder


def reported(flight: Path, out: Path, circumstances: Circumstances) -> dict[str, str]:
    """Detect, export and report; return the hashes of all files but run.json."""
    script = out.with_suffix(".py")
    script.write_text(
        _ALL_COMMANDS.format(
            is_library_call=circumstances.is_library_call,
            jobs=circumstances.jobs,
            flight=flight.as_posix(),
            out=out.as_posix(),
        ),
        encoding="utf-8",
    )
    subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, **circumstances.environment},
        capture_output=True,
        check=True,
    )
    return file_hashes(out)


def test_threads_and_jobs_change_no_byte(flight: Path, tmp_path: Path) -> None:
    first, other = circumstances(None)
    expected = reported(flight, tmp_path / "first", first)
    assert {"detections.parquet", "kgcps.parquet", "bias_report.html"} <= expected.keys()
    assert reported(flight, tmp_path / "other", other) == expected


def test_threads_change_no_byte_of_detections_by_other_kernels(
    flight: Path, tmp_path: Path
) -> None:
    first, other = circumstances("Nehalem")
    expected = process(flight, tmp_path / "first", first, only_detects=True)
    assert "detections.parquet" in expected
    assert process(flight, tmp_path / "other", other, only_detects=True) == expected
