"""Rings too small to show much of ink and plate beside their edges, in even and uneven light.

Usage: python -m benchmarks.accuracy.small_rings [--frames 60] [--seed 77]

Radii are 7 to 13 px. Each line is a camera of a preset of `kgcp simulate` and a kind of light: how
many of the targets are measured, the RMS error of the distance, its mean and RMS standardised, and
the RMS standardised error of the centre.
"""

from __future__ import annotations

from dataclasses import replace

import click
import cv2
import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Measurement
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import TARGET_PLATE, grow_ground, plan_flight, render_frame
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.presets import SimulationSettings, preset

_CAMERAS = ("clean", "consumer")
_LIGHTS: dict[str, dict[str, object]] = {
    "even": {},
    "half in shade": {"shadow": Shadow(light_left=0.5, edges=1, stripes=0)},
    "antenna's shadow": {"shadow": Shadow(light_left=0.6, edges=0, stripes=1)},
    "dirt": {"dirt": Dirt()},
    "highlights": {"glare": Glare()},
}
_DISTANCE_M = (80.0, 150.0)
_SIZE, _PRINCIPAL_POINT = (560, 420), (281.3, 207.2)


def settings_of(camera: str, light: str, frames: int) -> SimulationSettings:
    """Return a flight of small frames, each with the target."""
    chosen = preset(camera)
    (width, height), (cx, cy) = _SIZE, _PRINCIPAL_POINT
    return replace(
        chosen,
        frames=frames,
        absent_share=0.0,
        decoy_share=0.0,
        distance_m=_DISTANCE_M,
        camera=replace(chosen.camera, width=width, height=height, cx=cx, cy=cy),
        **_LIGHTS[light],  # type: ignore[arg-type] # of the settings' own names
    )


def errors_of(settings: SimulationSettings, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the relative errors of distances, and those of distance and centre standardised."""
    plan, ground = plan_flight(settings, seed), grow_ground(seed)
    relative, distance, centre = [], [], []
    for frame in plan.frames:
        grey = render_frame(plan, ground, frame.index)
        with single_threaded():
            seen = examine(grey, settings.camera, (TARGET_PLATE.target,), DetectSettings())
        for found in seen.outcomes:
            if not isinstance(found, Measurement) or found.uncertainty is None:
                continue
            error_m = found.distance_m - frame.target.distance_m
            relative.append(error_m / frame.target.distance_m)
            distance.append(error_m / found.sd_distance_m)
            true_px = settings.camera.project(frame.target.translation_m[None])[0]
            off_px = found.centre_px - true_px
            squares = off_px @ np.linalg.solve(found.uncertainty.centre_cov_px2, off_px)
            centre.append(np.sqrt(0.5 * squares))
    return np.array(relative), np.array(distance), np.array(centre)


@click.command()
@click.option("--frames", type=click.IntRange(2), default=60, show_default=True, help="Per line.")
@click.option("--seed", type=click.IntRange(0), default=77, show_default=True)
def main(frames: int, seed: int) -> None:
    """Print the table."""
    cv2.setNumThreads(0)
    print("camera    light             found  error [%]  z mean   z RMS  > 3  z of centre")
    for camera in _CAMERAS:
        for light in _LIGHTS:
            relative, z, centre = errors_of(settings_of(camera, light, frames), seed)
            print(
                f"{camera:10s}{light:18s}{len(z):5d}{100.0 * _rms(relative):11.3f}"
                f"{z.mean():8.2f}{_rms(z):8.2f}{np.count_nonzero(np.abs(z) > 3.0):5d}"
                f"{_rms(centre):13.2f}",
                flush=True,
            )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
