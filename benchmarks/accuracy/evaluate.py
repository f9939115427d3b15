"""Compare the measurements of a flight with the truth: detection and errors by ring radius.

Usage: python -m benchmarks.accuracy.evaluate FLIGHT TRUTH [--method paper] [--jobs 2]

TRUTH is the truth.csv of a simulated flight. A measurement is wrong if there is no target, or if
its centre is more than max(3 px, R/2) away from the true one.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import pandas as pd

from benchmarks.accuracy.bands import join_truth, read_truth, summarise, table_lines
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import read_detections
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.settings import DetectSettings, Method


def detect(flight_folder: Path, settings: DetectSettings, jobs: int) -> pd.DataFrame:
    """Run the detector on a flight, with a temporary folder of results, and return its table."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        flight = read_flight(flight_folder)
        summary = detect_flight(flight, settings, out=out, options=RunOptions(jobs=jobs))
        return read_detections(summary.table)


@click.command()
@click.argument("flight", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--method", type=click.Choice([m.value for m in Method]), default=DetectSettings().method.value
)
@click.option("--jobs", type=int, default=None)
def main(flight: Path, truth: Path, method: str, jobs: int | None) -> None:
    """Print the table."""
    settings = DetectSettings(method=Method(method))
    detections = detect(flight, settings, jobs or usable_cores())
    table = join_truth(detections, read_truth(truth))
    print(f"{flight}  method {method}  wrong {int(table['is_wrong'].sum())}")
    print("\n".join(table_lines(summarise(table))))


if __name__ == "__main__":
    main()
