"""Time and size of a bias report of many frames.

Usage: python -m benchmarks.speed.bias_report [--frames 5000]

A simulated flight of 60 frames is rendered and measured. Its frames and rows are then repeated,
with new noise of the distances, until there are enough frames, and the command makes the report.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from kgcp.cli import main as kgcp

_RENDERED = 60
_MOST_S, _MOST_MB = 20.0, 15.0


def repeat_flight(flight: Path, table: Path, frames: int) -> None:
    """Append copies of a flight to itself, shifted in time, until it has enough frames."""
    times = pd.read_csv(flight / "frames.csv", parse_dates=["time"])
    vehicle = pd.read_csv(flight / "vehicle.csv", parse_dates=["time"])
    reference = pd.read_csv(flight / "reference.csv")
    whole = pq.read_table(table)
    detections = whole.to_pandas()
    period = vehicle["time"].iloc[-1] - vehicle["time"].iloc[0] + pd.Timedelta(milliseconds=50)
    rng = np.random.default_rng(1)
    rounds = range(-(-frames // len(times)))
    tables: list[list[pd.DataFrame]] = [[], [], [], []]
    for turn in rounds:
        for kept, one in zip(tables, (times, vehicle, reference, detections), strict=True):
            copy = one.copy()
            if "frame" in copy:
                copy["frame"] = [f"{turn:04d}_{name}" for name in copy["frame"]]
            if "time" in copy:
                copy["time"] += turn * period
            if "distance_m" in copy:
                copy["distance_m"] += copy["sd_distance_m"] * rng.standard_normal(len(copy))
            kept.append(copy)
        for name in times["frame"]:
            os.link(flight / "frames" / name, flight / "frames" / f"{turn:04d}_{name}")
    for name, rows in zip(("frames.csv", "vehicle.csv", "reference.csv"), tables[:3], strict=True):
        together = pd.concat(rows)
        together = together[: frames if name == "frames.csv" else None]
        together.to_csv(flight / name, index=False, date_format="%Y-%m-%dT%H:%M:%S.%fZ")
    longer = pd.concat(tables[3]).iloc[:frames]
    pq.write_table(pa.Table.from_pandas(longer, whole.schema, preserve_index=False), table)


@click.command()
@click.option("--frames", type=click.IntRange(_RENDERED), default=5000, show_default=True)
@click.option("--keep", type=click.Path(path_type=Path), help="Folder in which to keep the report.")
def main(frames: int, keep: Path | None) -> None:
    """Print time and size; fail if they are above the limits for a report."""
    with tempfile.TemporaryDirectory() as folder:
        flight = Path(folder) / "flight"
        out = keep or flight / "kgcp"
        simulate = ["simulate", str(flight), "--preset", "exposure_sweep"]
        kgcp([*simulate, "--frames", str(_RENDERED)], standalone_mode=False)
        kgcp(["detect", str(flight), "--out", str(out), "--quiet"], standalone_mode=False)
        repeat_flight(flight, out / "detections.parquet", frames)
        report = [sys.executable, "-m", "kgcp", "bias-report", str(flight), "--out", str(out)]
        begin_s, begin_cpu_s = time.perf_counter(), os.times().children_user
        subprocess.run(report, check=True)
        seconds = time.perf_counter() - begin_s
        cpu_s = os.times().children_user - begin_cpu_s
        size_mb = (out / "bias_report.html").stat().st_size / 1e6
    print(
        f"{frames} frames: {seconds:.1f} s (limit {_MOST_S:g} s), {cpu_s:.1f} s of CPU,"
        f" {size_mb:.1f} MB (limit {_MOST_MB:g} MB)"
    )
    if seconds > _MOST_S or size_mb > _MOST_MB:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
