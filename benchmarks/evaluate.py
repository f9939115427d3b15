"""Compare what kgcp finds in a flight with the truth: found, present, wrong, errors by radius.

Usage: python benchmarks/evaluate.py FLIGHT TRUTH [--method paper] [--jobs 2]

TRUTH is the truth.csv of a simulated flight. A target is wrong if it is reported where there is
none, or with a centre more than max(3 px, R/2) away from the true one.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pandas as pd

from kgcp.io.flight import read_flight
from kgcp.io.tables import read_detections
from kgcp.settings import DetectSettings, Method
from kgcp.survey import detect_flight, usable_cores

RADIUS_BANDS_PX = ((26.0, np.inf), (13.0, 26.0), (9.0, 13.0), (0.0, 9.0))


@dataclass(frozen=True)
class BandResult:
    """Figures of one band of ring radius."""

    low_px: float
    high_px: float
    present: int
    found: int
    rms_percent: float
    mean_percent: float
    centre_rms_px: float


def detect(flight_folder: Path, settings: DetectSettings, jobs: int) -> pd.DataFrame:
    """Run the detector over a flight, in a folder that is thrown away, and return its table."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        detect_flight(
            read_flight(flight_folder), settings, out, jobs=jobs, on_frame=lambda _result: None
        )
        return read_detections(out / "detections.parquet")


def join_truth(detections: pd.DataFrame, truth_file: Path) -> pd.DataFrame:
    """Join every measured row with its frame's truth; rows of frames without a target stay."""
    truth = pd.read_csv(truth_file)
    measured = detections[detections["status"] == "measured"]
    table = truth.merge(measured, on="frame", how="left", suffixes=("_true", ""))
    table["is_measured"] = table["target"].notna()
    off_px = np.hypot(table["x_px"] - table["x"], table["y_px"] - table["y"])
    reach_px = np.maximum(3.0, 0.5 * table["radius_px_true"])
    table["is_right"] = table["is_measured"] & (table["present"] == 1) & (off_px <= reach_px)
    table["is_wrong"] = table["is_measured"] & ~table["is_right"]
    table["centre_error_px"] = off_px
    table["error_percent"] = 100.0 * (table["distance_m"] / table["distance"] - 1.0)
    return table


def summarise(table: pd.DataFrame) -> list[BandResult]:
    """Return the figures of every band of ring radius."""
    results = []
    for low, high in RADIUS_BANDS_PX:
        band = table[(table["radius_px_true"] >= low) & (table["radius_px_true"] < high)]
        present = band[band["present"] == 1]
        right = present[present["is_right"]]
        error = right["error_percent"]
        results.append(
            BandResult(
                low_px=low,
                high_px=high,
                present=int(present["frame"].nunique()),
                found=int(right["frame"].nunique()),
                rms_percent=float(np.sqrt((error**2).mean())),
                mean_percent=float(error.mean()),
                centre_rms_px=float(np.sqrt((right["centre_error_px"] ** 2).mean())),
            )
        )
    return results


@click.command()
@click.argument("flight", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option("--method", type=click.Choice(list(Method)), default=DetectSettings().method)
@click.option("--jobs", type=int, default=None)
def main(flight: Path, truth: Path, method: str, jobs: int | None) -> None:
    """Print the table."""
    settings = DetectSettings(method=Method(method))
    table = join_truth(detect(flight, settings, jobs or usable_cores()), truth)
    print(f"{flight}  method {method}  wrong {int(table['is_wrong'].sum())}")
    print("        R px  found/present  distance RMS %   mean %  centre RMS px")
    for band in summarise(table):
        print(
            f"{band.low_px:5.0f}–{band.high_px:<6.0f}  {band.found:5d}/{band.present:<7d}"
            f"  {band.rms_percent:14.4f}  {band.mean_percent:+7.4f}  {band.centre_rms_px:13.4f}"
        )


if __name__ == "__main__":
    main()
