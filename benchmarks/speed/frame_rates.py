"""Frames per second of `kgcp detect` on one machine, by size of frames and number of jobs.

Linux only: it reads the CPU time of the processes in /proc.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import click

from benchmarks.reliability.soak import samples, speed_between
from benchmarks.reliability.torture import Life, detecting
from benchmarks.speed.sources import with_larger_camera
from kgcp.io.images.frames import list_frames
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import preset

_PRESET = "consumer"  # colour JPEG
_RENDERED = 12
_SCALES = {1.0: 160, 2.5: 60}  # scale of the preset's camera → number of frames
_WARM = 0.2  # share of the frames before the clock starts
_JOBS = (1, 2)


def make_flight(folder: Path, scale: float, frames: int) -> str:
    """Write a flight of a camera with more pixels; return its frame size in words."""
    settings = with_larger_camera(replace(preset(_PRESET), frames=_RENDERED), scale)
    larger = settings.camera
    plan = plan_flight(settings, 1)
    write_simulated_flight(plan, folder, jobs=usable_cores(), on_frame=lambda: None)
    names = list_frames(folder / "frames")
    for number in range(_RENDERED, frames):
        name = names[number % _RENDERED]
        (folder / "frames" / f"again_{number}_{name}").hardlink_to(folder / "frames" / name)
    return f"{larger.width} x {larger.height} px, {1e-6 * larger.width * larger.height:.1f} Mpx"


@click.command()
def main() -> None:
    """Print a line per size and number of jobs."""
    for scale, frames in _SCALES.items():
        with tempfile.TemporaryDirectory() as folder:
            flight = Path(folder) / "flight"
            size = make_flight(flight, scale, frames)
            for jobs in _JOBS:
                life = Life(detecting(flight, Path(folder) / str(jobs), jobs))
                taken = list(samples(life))
                if life.end() != 0:
                    raise RuntimeError("".join(life.lines[-20:]))
                speed = speed_between(taken, _WARM * frames, frames)
                print(
                    f"{size}, {jobs} jobs: {speed.per_s:.1f} frames/s,"
                    f" {1e3 / speed.per_cpu_s:.0f} ms of CPU time per frame,"
                    f" {max(sample.workers_mb for sample in taken):.0f} MB per worker",
                    flush=True,
                )


if __name__ == "__main__":
    main()
