"""One line for each of several simulated flights: the figures by which they are accepted.

Usage: python -m benchmarks.accuracy.flights FLIGHT... [--jobs 2]

The truth.csv of a flight is in its folder or beside it. Columns: targets found and present; RMS
error of the distance for rings of R ≥ 26 px and of 13–26 px [%]; mean error with two standard
errors for R ≥ 26 px [%]; RMS of the errors divided by their reported standard deviations, of
distance and centre; share of distances that are off by more than three standard deviations; median
squared Mahalanobis distance of the pose; and the number of normals on the wrong side, among those
whose two sides are more than three standard deviations apart by the known attitudes.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import pandas as pd

from benchmarks.accuracy.bands import join_truth, read_truth, summarise
from benchmarks.accuracy.evaluate import detect
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.frame_priors import priors_of_frames
from kgcp.settings import DetectSettings

HEADER = (
    "flight               found   R ≥ 26  13–26 %   mean % ± 2 se   z dist centre    > 3 σ  Mahal.²"
    "  wrong side"
)
_SIGMAS = 3.0


def truth_path(flight: Path) -> Path:
    """Return the truth.csv of a flight, which is in its folder or beside it."""
    within = flight / "truth.csv"
    return within if within.exists() else flight.parent / "truth.csv"


def sides_told_apart(flight: Flight, right: pd.DataFrame) -> pd.Series:
    """Return whether the known attitudes tell the two possible normals of measured targets apart.

    The normals are mirrored about the viewing ray, so that twice the tilt lies between them. If no
    attitudes are known, they cannot be told apart.
    """
    frames = list(right["frame"])
    priors = priors_of_frames(flight, FlightData(flight, frames), frames)
    sds_deg = []
    for target, by_target in zip(right["target"], priors, strict=True):
        prior = by_target.get(target)
        known = None if prior is None else prior.normal
        sds_deg.append(np.inf if known is None else known.sd_deg)
    return 2.0 * right["tilt_deg"] > _SIGMAS * pd.Series(sds_deg, index=right.index)


def line_of(name: str, flight: Flight, table: pd.DataFrame) -> str:
    """Return the line of one flight; `table` is the result of `join_truth`."""
    large, middle, *_ = summarise(table)
    right = table[table["is_right"]]
    distinct = right[sides_told_apart(flight, right)]
    wrong = int((distinct["on_right_side"] == 0.0).sum())
    z, centre = (
        float(np.sqrt(np.mean(np.square(right[each].astype(float)))))
        for each in ("z_distance", "z_centre")
    )
    return (
        f"{name:16s} {right['frame'].nunique():4d}/{int((table['present'] == 1).sum()):<4d}"
        f" {large.rms_percent:8.4f} {middle.rms_percent:8.4f}"
        f"  {large.mean_percent:+.4f} ± {large.mean_2se_percent:.4f}"
        f" {z:7.2f} {centre:7.2f} {100.0 * (right['z_distance'].abs() > _SIGMAS).mean():6.1f} %"
        f" {right['mahalanobis2'].median():7.2f} {wrong:4d}/{len(distinct)}"
    )


@click.command()
@click.argument("flights", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(flights: tuple[Path, ...], jobs: int | None) -> None:
    """Print the table."""
    print(HEADER)
    for folder in flights:
        truth = truth_path(folder)
        table = join_truth(
            detect(folder, DetectSettings(), jobs or usable_cores()), read_truth(truth)
        )
        name = truth.parent.name  # a folder called flight may have the truth beside it
        print(line_of(name, read_flight(folder), table), flush=True)


if __name__ == "__main__":
    main()
