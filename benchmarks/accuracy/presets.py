"""Simulate a flight of every preset, measure it, and print errors, scatter and bound by radius.

Usage: python -m benchmarks.accuracy.presets [--quick] [--frames 36] [--seed 1] [--jobs 2] [--keep
DIR]

See benchmarks/README.md for the columns.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import astuple, replace
from pathlib import Path

import click
import pandas as pd

from benchmarks.accuracy.bands import BOUND_COLUMNS, join_truth, read_truth, summarise, table_lines
from benchmarks.accuracy.bound import frame_bound
from benchmarks.accuracy.evaluate import detect
from benchmarks.pool import ordered_map
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.execution.threads import use_one_thread_each
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.settings import DetectSettings, Method
from kgcp.simulation.crlb import Bound
from kgcp.simulation.flight import FlightPlan, FramePlan, frame_name, plan_flight
from kgcp.simulation.presets import PRESETS, SimulationSettings, preset

PRESET_NAMES = ("clean", "exposure_sweep", "consumer", "blurred", "oblique", "far")
_FRAMES = 36
_QUICK_FRAMES = 12


def plan_preset(name: str, frames: int, seed: int) -> FlightPlan:
    """Plan a preset's flight with another number of frames."""
    return plan_flight(replace(preset(name), frames=frames), seed)


def simulate(plan: FlightPlan, keep: Path, jobs: int) -> Path:
    """Return the folder of the plan's flight in `keep`; render the flight if it is missing."""
    folder = keep / f"{plan.settings.name}_{plan.settings.frames}_{plan.seed}"
    if not (folder / "truth.csv").is_file():
        keep.mkdir(parents=True, exist_ok=True)
        write_simulated_flight(plan, folder, jobs=jobs, on_frame=lambda: None)
    return folder


def compare(plan: FlightPlan, folder: Path, settings: DetectSettings, jobs: int) -> pd.DataFrame:
    """Measure a simulated flight; return its rows with their truth, errors and bounds."""
    table = join_truth(detect(folder, settings, jobs), read_truth(folder / "truth.csv"))
    found = set(table.loc[table["is_right"], "frame"])
    frames = [f for f in plan.frames if frame_name(plan.settings, f.index) in found]
    return table.merge(bounds_of(plan.settings, frames, jobs), on="frame", how="left")


def bounds_of(settings: SimulationSettings, frames: list[FramePlan], jobs: int) -> pd.DataFrame:
    """Return the bounds of frames, all of which show the target."""
    bounds = ordered_map(
        _bound_in_worker,
        [(settings, frame) for frame in frames],
        jobs=jobs,
        start=use_one_thread_each,
        start_arguments=(),
    )
    rows = [
        (frame_name(settings, frame.index), *astuple(bound))
        for frame, bound in zip(frames, bounds, strict=True)
    ]
    return pd.DataFrame(rows, columns=["frame", *BOUND_COLUMNS])


def _bound_in_worker(task: tuple[SimulationSettings, FramePlan]) -> Bound:
    return frame_bound(*task)


@contextlib.contextmanager
def _folder_or_temporary(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="kgcp_accuracy_") as folder:
        yield Path(folder)


@click.command()
@click.option("--preset", "names", multiple=True, type=click.Choice(tuple(PRESETS)))
@click.option("--frames", type=click.IntRange(2), default=None, help="Frames per preset.")
@click.option("--quick", is_flag=True, help=f"{_QUICK_FRAMES} frames per preset.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option(
    "--keep",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder that keeps the simulated flights, to reuse them the next time.",
)
@click.option(
    "--method", type=click.Choice([m.value for m in Method]), default=DetectSettings().method.value
)
def main(
    names: tuple[str, ...],
    frames: int | None,
    seed: int,
    jobs: int | None,
    keep: Path | None,
    method: str,
    *,
    quick: bool,
) -> None:
    """Print the tables."""
    settings = DetectSettings(method=Method(method))
    count, jobs = frames or (_QUICK_FRAMES if quick else _FRAMES), jobs or usable_cores()
    with _folder_or_temporary(keep) as root:
        for name in names or PRESET_NAMES:
            plan = plan_preset(name, count, seed)
            folder = simulate(plan, root, jobs)
            table = compare(plan, folder, settings, jobs)
            print(f"{name}  {count} frames  method {method}  wrong {int(table['is_wrong'].sum())}")
            print("\n".join(table_lines(summarise(table))), flush=True)


if __name__ == "__main__":
    main()
