"""CPU time of kgcp relative to decoding the same frames, effect of jobs and size, memory.

Usage: python -m benchmarks.speed.relative_costs [--flights DIR] [--photos DIR] [--frames 10]

The DIR of --flights has NAME/flight/flight.toml; that of --photos has photographs without any
target. If one is missing, simulated frames are used instead. benchmarks/README.md explains the
lines of the table.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click

from kgcp.pipeline.execution.threads import use_one_thread_each


@click.command()
@click.option("--flights", type=click.Path(path_type=Path), default=None, help="Folder of flights.")
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of photographs without targets.",
)
@click.option(
    "--frames", type=click.IntRange(2), default=10, show_default=True, help="Frames per line."
)
def main(flights: Path | None, photos: Path | None, frames: int) -> None:
    """Print the tables."""
    use_one_thread_each()  # before any library of numbers is loaded
    from benchmarks.speed.costs import HEADER, Costs, cost_line, print_costs, use_one_opencv_thread
    from benchmarks.speed.runs import help_line, jobs_line, size_lines
    from benchmarks.speed.sources import flights_of, large_flight, photograph_of, photographs_of

    use_one_opencv_thread()
    with tempfile.TemporaryDirectory(prefix="kgcp_speed_") as folder:
        work = Path(folder)
        sources = flights_of(flights, work, frames)
        photographs = photographs_of(photos, sources[0])
        print("CPU time in one process, on one thread, divided by that of decoding", flush=True)
        print(HEADER, flush=True)
        of_flights = tuple(print_costs(sources, frames))
        print(cost_line(Costs("flights together", "both", of_flights)), flush=True)
        tuple(print_costs([large_flight(work)], frames))
        of_photographs = tuple(print_costs(photographs, frames))
        if of_photographs:
            together = Costs("photographs together", "without", of_photographs)
            print(cost_line(together), flush=True)
        print(jobs_line(sources[0], work), flush=True)
        print(help_line(), flush=True)
        for line in size_lines(photograph_of(photographs, sources[0]), work):
            print(line, flush=True)


if __name__ == "__main__":
    main()
