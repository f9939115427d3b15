"""Flights with a camera that is out of focus: the figures by which such flights are accepted.

Usage: python -m benchmarks.accuracy.defocus [--preset clean ...] [--defocus 2 ...] [--frames 40]

Defocus spreads a point into a uniform disc, while a focused lens makes a nearly Gaussian spot.
There is a line for each preset and radius of that disc [px], with the columns of
`benchmarks.accuracy.flights`.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import click

from benchmarks.accuracy.bands import join_truth, read_truth
from benchmarks.accuracy.evaluate import detect
from benchmarks.accuracy.flights import HEADER, line_of, with_sides
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.settings import DetectSettings
from kgcp.simulation.effects import Effects, with_effects
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import PRESETS, preset

_PRESETS = ("clean", "consumer", "lens", "shadow", "glare")
_DEFOCUS_PX = (0.0, 1.0, 1.5, 2.0, 3.0)


@click.command()
@click.option("--preset", "names", multiple=True, default=_PRESETS, type=click.Choice([*PRESETS]))
@click.option(
    "--defocus",
    "radii_px",
    multiple=True,
    type=float,
    default=_DEFOCUS_PX,
    help="Radius of the disc into which defocus spreads a point [px].",
)
@click.option("--frames", type=click.IntRange(2), default=40, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=5, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(
    names: tuple[str, ...],
    radii_px: tuple[float, ...],
    frames: int,
    seed: int,
    jobs: int | None,
) -> None:
    """Print the table."""
    print(HEADER)
    for name in names:
        for radius_px in radii_px:
            settings = replace(preset(name), frames=frames)
            wanted = replace(Effects.of(settings), defocus=radius_px)
            plan = plan_flight(with_effects(settings, wanted), seed)
            with tempfile.TemporaryDirectory(prefix="kgcp_defocus_") as folder:
                flight = Path(folder) / "flight"
                workers = jobs or usable_cores()
                write_simulated_flight(plan, flight, jobs=workers, on_frame=lambda: None)
                table = detect(flight, DetectSettings(), workers)
                table = join_truth(table, read_truth(flight / "truth.csv"))
                table = with_sides(read_flight(flight), table)
                print(line_of(f"{name} {radius_px:g} px", table), flush=True)


if __name__ == "__main__":
    main()
