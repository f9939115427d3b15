"""The same bytes, for any number of threads and jobs, also if numpy was loaded before.

`python -m benchmarks.reliability.same_bytes` has more circumstances: what is compiled when, and by
whom.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.reliability.same_bytes import Circumstances, make_flight, process


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


@pytest.mark.parametrize("core", [None, "Nehalem"])
def test_threads_and_jobs_change_no_byte(core: str | None, flight: Path, tmp_path: Path) -> None:
    first, other = circumstances(core)
    is_other = core is not None
    expected = process(flight, tmp_path / "first", first, only_detects=is_other)
    wanted = {"detections.parquet"} if is_other else {"kgcps.parquet", "bias_report.html"}
    assert wanted <= expected.keys()
    assert process(flight, tmp_path / "other", other, only_detects=is_other) == expected
