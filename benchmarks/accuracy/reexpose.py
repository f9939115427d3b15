"""Measure a flight again with its grey values × 0.6 and × 1.6: Figure 10 of Cucci (2016).

Usage: python -m benchmarks.accuracy.reexpose FLIGHT TRUTH [--method paper] [--jobs 2]

A measurement that depends on the exposure moves. Grey values above white clip, all are rounded.
"""

from __future__ import annotations

from pathlib import Path

import click
import cv2
import numpy as np
import pandas as pd

from benchmarks.accuracy.bands import RADIUS_BANDS_PX, join_truth, read_truth
from benchmarks.accuracy.timing import time_measurement, timing_line
from benchmarks.pool import ordered_map
from kgcp.errors import Rejection
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.images.frames import list_frames, read_grey
from kgcp.io.tables.columns import Row
from kgcp.io.tables.detections import detection_rows
from kgcp.measurement.records import ExposureSettings, FrameResult, Miss
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.measure import measure_frame
from kgcp.report.bias.reexposure import GAINS, reexposed
from kgcp.settings import DetectSettings, Method
from kgcp.targets.plain import Shape


def measure_flight(
    flight: Flight, settings: DetectSettings, gain: float, jobs: int
) -> pd.DataFrame:
    """Return the rows of detections.parquet for a flight with all grey values times `gain`."""
    frames = list_frames(flight.frames_folder)
    rows = ordered_map(
        _rows_of_frame,
        [(flight, settings, frame, gain) for frame in frames],
        jobs=jobs,
        start=cv2.setNumThreads,
        start_arguments=(0,),
    )
    return pd.DataFrame([row for of_frame in rows for row in of_frame])


def _rows_of_frame(task: tuple[Flight, DetectSettings, str, float]) -> list[Row]:
    flight, settings, frame, gain = task
    grey = reexposed(read_grey(flight.frames_folder / frame, flight.camera), gain)
    try:
        outcomes = tuple(measure_frame(grey, flight.camera, flight.targets, settings))
    except Rejection as rejection:
        outcomes = tuple(
            Miss(target.name, rejection.reason, rejection.detail) for target in flight.targets
        )
    shapes = dict.fromkeys((target.name for target in flight.targets), Shape.CODED)
    return detection_rows(FrameResult(frame, None, ExposureSettings(), outcomes), shapes)


def changes(before: pd.DataFrame, after: pd.DataFrame) -> pd.DataFrame:
    """Return what re-exposure did to every target found in the unchanged flight.

    Parameters
    ----------
    before, after : DataFrame
        Of `join_truth`.

    Returns
    -------
    DataFrame
        `frame`, `radius_px` (true), `change_percent` of the distance; NaN where it was lost.
    """
    columns = ["frame", "target", "distance_m"]
    pair = before[before["is_right"]].merge(
        after.loc[after["is_right"], columns], on=["frame", "target"], how="left"
    )
    change = 100.0 * (pair["distance_m_y"] / pair["distance_m_x"] - 1.0)
    return pd.DataFrame(
        {"frame": pair["frame"], "radius_px": pair["radius_px_true"], "change_percent": change}
    )


def print_changes(gain: float, table: pd.DataFrame) -> None:
    """Print the changes by band of ring radius."""
    print(f"grey values × {gain:g}")
    print("      R px  found/before  RMS change %  largest change %")
    for low, high in RADIUS_BANDS_PX:
        band = table[(table["radius_px"] >= low) & (table["radius_px"] < high)]
        change = band["change_percent"].abs()
        print(
            f"{low:4.0f}–{high:<5.0f}  {change.count():5d}/{len(change):<6d}"
            f"  {np.sqrt((change**2).mean()):12.4f}  {change.max():16.4f}"
        )


@click.command()
@click.argument("flight", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--method", type=click.Choice([m.value for m in Method]), default=DetectSettings().method.value
)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(flight: Path, truth: Path, method: str, jobs: int | None) -> None:
    """Print the tables, and the measurement's CPU time on the unchanged frames."""
    settings = DetectSettings(method=Method(method))
    the_flight, true, jobs = read_flight(flight), read_truth(truth), jobs or usable_cores()
    before = join_truth(measure_flight(the_flight, settings, 1.0, jobs), true)
    print(f"{flight}  method {method}")
    for gain in GAINS:
        after = join_truth(measure_flight(the_flight, settings, gain, jobs), true)
        print_changes(gain, changes(before, after))
    print(timing_line(time_measurement(the_flight, list_frames(the_flight.frames_folder))))


if __name__ == "__main__":
    main()
