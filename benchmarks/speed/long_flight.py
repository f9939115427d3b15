"""Wall time of `kgcp detect` on a long flight, with one job and with two.

Usage: python -m benchmarks.speed.long_flight [--frames 2000] [--preset consumer] [--repeats 2]

Forty simulated frames are repeated under other names. Runs with one job and with two take turns.
The shortest run of each counts, since other work of the machine only adds time.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import click

from benchmarks.speed.start_up import detecting, run
from kgcp.io.images.frames import list_frames
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import preset

_RENDERED = 40
_JOBS = (1, 2)


def make_flight(folder: Path, name: str, frames: int) -> None:
    """Simulate some frames of a preset, and repeat them."""
    plan = plan_flight(replace(preset(name), frames=_RENDERED), 1)
    # jobs 0: a server of worker processes would never end, and `run` would wait for it
    write_simulated_flight(plan, folder, jobs=0, on_frame=lambda: None)
    names = list_frames(folder / "frames")
    for number in range(_RENDERED, frames):
        name = names[number % _RENDERED]
        (folder / "frames" / f"again_{number:06d}_{name}").hardlink_to(folder / "frames" / name)


@click.command()
@click.option("--frames", type=click.IntRange(_RENDERED), default=2000, show_default=True)
@click.option("--preset", "name", default="consumer", show_default=True)
@click.option("--repeats", type=click.IntRange(1), default=2, show_default=True)
def main(frames: int, name: str, repeats: int) -> None:
    """Print the shortest wall time per number of jobs, and how much faster two jobs are."""
    with tempfile.TemporaryDirectory() as folder:
        flight = Path(folder) / name
        make_flight(flight, name, frames)
        run(detecting(flight, "--frames", "frame_*"))  # compiles
        walls_s: dict[int, list[float]] = {jobs: [] for jobs in _JOBS}
        for _ in range(repeats):
            for jobs, taken_s in walls_s.items():
                taken_s.append(run(detecting(flight, "--jobs", str(jobs))).wall_s)
    one_s, two_s = (min(taken_s) for taken_s in walls_s.values())
    print(
        f"{name}, {frames} frames: {one_s:.1f} s with one job, {two_s:.1f} s with two:"
        f" {one_s / two_s:.2f} times as fast"
    )


if __name__ == "__main__":
    main()
