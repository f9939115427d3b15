"""The torture of `make torture`, in small: a few kills."""

from __future__ import annotations

import random
from pathlib import Path

from benchmarks.reliability.torture import detecting, make_flight, torture
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.detect import RunOptions, detect_flight
from tests.systems import not_on_windows


@not_on_windows("lists no workers in /proc")
def test_a_run_that_is_killed_again_and_again_ends_with_the_same_table(tmp_path: Path) -> None:
    flight, out, tortured = (tmp_path / name for name in ("flight", "out", "tortured"))
    make_flight(flight, 20, 1, rendered=5)
    detect_flight(read_flight(flight), out=out, options=RunOptions(jobs=0))
    rng = random.Random(287)  # noqa: S311 - kills a worker, and the run soon after
    toll = torture(detecting(flight, tortured, 1), tortured, 2, rng)
    assert toll.kills >= 2
    tables = [(folder / "detections.parquet").read_bytes() for folder in (out, tortured)]
    assert tables[0] == tables[1]
    assert {path.name for path in tortured.iterdir()} == {"detections.parquet", "run.json"}
