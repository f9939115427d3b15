"""One line for each of several simulated flights: the figures by which they are accepted.

Usage: python -m benchmarks.accuracy.flights FLIGHT... [--jobs 2]

The truth.csv of a flight is in its folder or beside it. Columns: targets found and present; RMS
error of the distance for rings of R ≥ 26 px and of 13–26 px [%]; mean error with two standard
errors for R ≥ 26 px [%]; RMS of the errors divided by their reported standard deviations, of
distance and centre; share of distances that are off by more than three standard deviations; median
squared Mahalanobis distance of the pose; and the number of normals on the wrong side, among those
whose two sides are more than three standard deviations apart by the known attitudes.

Flights in one folder are a set, and a line follows with the figures of all its frames. Those of one
flight vary by chance: the RMS of 15 standardised errors whose standard deviations are right lies
outside 0.8 to 1.25 in 23 of 100 cases, and the median of 15 squared Mahalanobis distances outside 4
to 7 in 15.
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


def with_sides(flight: Flight, table: pd.DataFrame) -> pd.DataFrame:
    """Add `is_distinct`, whether `sides_told_apart`, to a flight's result of `join_truth`."""
    told = sides_told_apart(flight, table[table["is_right"]])
    return table.assign(is_distinct=told.reindex(table.index, fill_value=False))


def line_of(name: str, table: pd.DataFrame) -> str:
    """Return the line of one flight or of several; `table` is by `with_sides`."""
    large, middle, *_ = summarise(table)
    right = table[table["is_right"]]
    distinct = right[right["is_distinct"]]
    wrong = int((distinct["on_right_side"] == 0.0).sum())
    z, centre = (
        float(np.sqrt(np.mean(np.square(right[each].astype(float)))))
        for each in ("z_distance", "z_centre")
    )
    return (
        f"{name:16s} {len(right):4d}/{int((table['present'] == 1).sum()):<4d}"
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
    sets: dict[Path, list[pd.DataFrame]] = {}
    for folder in flights:
        # a folder called flight may have the truth beside it
        truth = truth_path(folder).resolve()
        found = detect(folder, DetectSettings(), jobs or usable_cores())
        table = with_sides(read_flight(folder), join_truth(found, read_truth(truth)))
        named = truth.parent
        print(line_of(named.name, table), flush=True)
        sets.setdefault(named.parent, []).append(table)
    for parent, tables in sets.items():
        if len(tables) > 1:
            together = pd.concat(tables, ignore_index=True)
            print(line_of(f"all in {parent.name}", together), flush=True)


if __name__ == "__main__":
    main()
