"""Plates half in shade: detection and errors, by the share of light left in the shade.

Usage: python -m benchmarks.search.shaded_rings [--frames 40] [--seed 5]

Each frame has a target of R 7 to 35 px, and the edge of one shadow runs across it.
"""

from __future__ import annotations

from dataclasses import replace

import click
import numpy as np

from benchmarks.accuracy.ring_sizes import errors_of, settings_of
from kgcp.simulation.light_settings import Shadow

_LINES = (("clean", 0.5), ("clean", 0.35), ("clean", 0.25), ("consumer", 0.3))
_DISTANCE_M = (30.0, 140.0)


@click.command()
@click.option(
    "--frames", type=click.IntRange(2), default=40, show_default=True, help="Frames per line."
)
@click.option("--seed", type=click.IntRange(0), default=5, show_default=True)
def main(frames: int, seed: int) -> None:
    """Print the table."""
    print("camera    light left  measured  error: median, RMS [%]   z: distance, centre   |z| > 3")
    for camera, light_left in _LINES:
        shadow = Shadow(light_left=light_left, edges=1, stripes=0)
        settings = settings_of(camera, "even", frames)
        settings = replace(settings, distance_m=_DISTANCE_M, shadow=shadow)
        errors = errors_of(settings, seed)
        relative, distance, centre = errors.relative, errors.distance, errors.centre
        if not len(relative):
            print(f"{camera:10s}{light_left:10.2f}{0:10d}", flush=True)
            continue
        median, rms = np.median(np.abs(relative)), np.sqrt(np.mean(relative**2))
        print(
            f"{camera:10s}{light_left:10.2f}{len(relative):10d}{100.0 * median:16.3f}"
            f"{100.0 * rms:11.3f}{np.sqrt(np.mean(distance**2)):15.2f}"
            f"{np.sqrt(np.mean(centre**2)):8.2f}{np.count_nonzero(np.abs(distance) > 3.0):5d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
