"""Measure the figures that `kgcp plan` uses: detection rates, and ratios of errors to bounds.

Usage: python -m benchmarks.accuracy.planning [--frames 150] [--flights 12] [--seed 1] [--jobs 2]
                                     [--keep DIR]

See benchmarks/README.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
import pandas as pd

from benchmarks.accuracy.presets import PRESET_NAMES, compare, plan_preset, simulate
from benchmarks.search.hard_frames import run_set
from benchmarks.search.scene import radius_px
from benchmarks.search.sets import SETS_BY_NAME
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.settings import DetectSettings

_SETS = ("small", "middle", "large")  # sets whose frames show one plate each
_RADII_PX = (6.0, 7.0, 8.0, 9.0, 13.0, 26.0, 60.0, 150.0, 1e4)


def found_by_radius(frames: int, seed: int, jobs: int) -> Iterator[tuple[float, float, int, int]]:
    """Yield bands of ring radius, with the numbers of plates that were found and shown in them."""
    radii_px: list[float] = []
    found: list[bool] = []
    for name in _SETS:
        for verdict in run_set(SETS_BY_NAME[name], frames, seed, jobs):
            shot = SETS_BY_NAME[name].shot(seed, verdict.index)
            (plate,) = shot.wanted
            radii_px.append(radius_px(shot.camera, plate))
            found.append(verdict.found == 1)
    for low, high in pairwise(_RADII_PX):
        within = (np.array(radii_px) >= low) & (np.array(radii_px) < high)
        if within.any():
            yield low, high, int(np.sum(np.array(found)[within])), int(within.sum())


def scatter_over_bound(
    names: tuple[str, ...], frames: int, seed: int, jobs: int, keep: Path
) -> tuple[float, float, int]:
    """Return the RMS of error over bound, of distance and centre, and the number of targets."""
    tables = []
    for name in names:
        plan = plan_preset(name, frames, seed)
        tables.append(compare(plan, simulate(plan, keep, jobs), DetectSettings(), jobs))
    table = pd.concat(tables)
    right = table[table["is_right"]]
    ratios = (
        right["error_percent"] / right["bound_distance_percent"],
        right["centre_error_px"] / right["bound_centre_px"],
    )
    distance, centre = (float(np.sqrt(np.mean(np.square(ratio)))) for ratio in ratios)
    return distance, centre, len(right)


@click.command()
@click.option(
    "--frames", type=click.IntRange(1), default=150, show_default=True, help="Frames per set."
)
@click.option("--flights", type=click.IntRange(2), default=12, show_default=True,
              help="Frames per simulated flight.")  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option(
    "--keep", type=click.Path(path_type=Path), required=True, help="Folder of the flights."
)
def main(frames: int, flights: int, seed: int, jobs: int | None, keep: Path) -> None:
    """Print the ratios and the detection rates."""
    cores = jobs or usable_cores()
    linear = tuple(name for name in PRESET_NAMES if name != "consumer")
    for names in (linear, ("consumer",)):
        distance, centre, count = scatter_over_bound(names, flights, seed, cores, keep)
        print(
            f"scatter / bound, {', '.join(names)}: distance {distance:.2f}, centre {centre:.2f}"
            f" ({count} targets)",
            flush=True,
        )
    for low, high, found, shown in found_by_radius(frames, seed, cores):
        print(f"R {low:g}–{high:g} px: found {found} of {shown}", flush=True)


if __name__ == "__main__":
    main()
