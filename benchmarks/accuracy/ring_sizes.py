"""Errors of rings of one range of sizes, in even and uneven light.

Usage: python -m benchmarks.accuracy.ring_sizes [--size small] [--frames 60] [--quality 85]

Small rings have radii of 7 to 13 px, so that hardly any pixels of ink and plate are away from
edges. Middle ones have radii of 37 to 140 px. Large ones have radii of 150 to 290 px; kgcp measures
them in binned pixels, or in some of their pixels. Each line is for a camera and a kind of light:
number of targets measured, RMS error of the distance [%], mean and RMS of its standardised error,
number of distances that are off by more than three standard deviations, RMS standardised error of
the centre, and median CPU time of a frame [ms]. The cameras are those of presets of `kgcp
simulate`, and `srgb`, which is the camera of `clean` with a stated sRGB curve. With `--quality`,
frames are compressed as JPEG; `--astigmatism`, `--coma` and `--defocus` are those of `kgcp
simulate`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cache, partial

import click
import cv2
import numpy as np

from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Measurement
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.simulate import encode_image
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import (
    TARGET_PLATE,
    FlightPlan,
    grow_ground,
    plan_flight,
    render_frame,
)
from kgcp.simulation.imaging import ToneCurve
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.presets import SimulationSettings, preset

_CLEAN = preset("clean")
_CAMERAS = {
    "clean": _CLEAN,
    "srgb": replace(
        _CLEAN,
        camera=replace(_CLEAN.camera, response=Response.SRGB),
        sensor=replace(_CLEAN.sensor, tone=ToneCurve.SRGB),
    ),
    **{name: preset(name) for name in ("consumer", "phone", "simple_phone")},
}
_BURNT: dict[str, object] = {"gain": (1.15, 2.2)}
_HALF_IN_SHADE: dict[str, object] = {"shadow": Shadow(light_left=0.5, edges=1, stripes=0)}
_ANTENNAS_SHADOW: dict[str, object] = {"shadow": Shadow(light_left=0.6, edges=0, stripes=1)}
_LIGHTS: dict[str, dict[str, object]] = {
    "even": {},
    "burnt": _BURNT,
    "half in shade": _HALF_IN_SHADE,
    "antenna's shadow": _ANTENNAS_SHADOW,
    "both shadows": {"shadow": Shadow(light_left=0.5, edges=1, stripes=1)},
    "burnt, half in shade": {**_BURNT, **_HALF_IN_SHADE},
    "burnt, antenna's": {**_BURNT, **_ANTENNAS_SHADOW},
    "dirt": {"dirt": Dirt()},
    "highlights": {"glare": Glare()},
}


@dataclass(frozen=True, slots=True)
class Size:
    """Range of distances for a range of ring sizes, and the frame to render."""

    distance_m: tuple[float, float]
    frame_px: tuple[int, int]
    principal_point_px: tuple[float, float]


SIZES = {
    "small": Size((80.0, 150.0), (560, 420), (281.3, 207.2)),
    "middle": Size((7.0, 30.0), (720, 540), (362.6, 266.4)),
    "large": Size((3.5, 7.0), (1120, 840), (562.6, 414.4)),
}


def settings_of(
    camera: str, light: str, frames: int, size: Size = SIZES["small"], quality: int | None = None
) -> SimulationSettings:
    """Return the settings of a flight with frames that are not much larger than the target."""
    chosen = _CAMERAS[camera]
    (width, height), (cx, cy) = size.frame_px, size.principal_point_px
    return replace(
        chosen,
        frames=frames,
        absent_share=0.0,
        decoy_share=0.0,
        distance_m=size.distance_m,
        jpeg_quality=quality,
        camera=replace(chosen.camera, width=width, height=height, cx=cx, cy=cy),
        **_LIGHTS[light],  # type: ignore[arg-type] # names of settings
    )


@dataclass(frozen=True, slots=True, eq=False)
class RingErrors:
    """Errors of the measured targets (n,), and the CPU time of a frame."""

    relative: FloatArray  # relative errors of the distance
    distance: FloatArray  # the same errors divided by their standard deviations
    centre: FloatArray  # errors of the centre per axis, divided by their standard deviations
    seconds: float  # median CPU time of a frame


_ground_of = cache(grow_ground)  # once per process


def errors_in_frame(plan: FlightPlan, index: int) -> tuple[list[FloatArray], float]:
    """Return three errors (3,) of each measured target, and the CPU time [s].

    The errors are those of the distance, relative and standardised, and of the centre,
    standardised.
    """
    frame, camera = plan.frames[index], plan.settings.camera
    rendered = render_frame(plan, _ground_of(plan.seed), index)
    file = np.frombuffer(encode_image(rendered, plan.settings.jpeg_quality), np.uint8)
    grey = np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE))
    with single_threaded():
        begin_s = time.process_time()
        seen = examine(grey, camera, (TARGET_PLATE.target,), DetectSettings())
        seconds = time.process_time() - begin_s
    errors = []
    for found in seen.outcomes:
        if not isinstance(found, Measurement) or found.uncertainty is None:
            continue
        error_m = found.distance_m - frame.target.distance_m
        off_px = found.centre_px - camera.project(frame.target.translation_m[None])[0]
        squares = off_px @ np.linalg.solve(found.uncertainty.centre_cov_px2, off_px)
        relative = error_m / frame.target.distance_m
        errors.append(np.array((relative, error_m / found.sd_distance_m, np.sqrt(0.5 * squares))))
    return errors, seconds


def errors_of(settings: SimulationSettings, seed: int, jobs: int = 1) -> RingErrors:
    """Return the errors of all frames of a flight."""
    found = list(
        ordered_map(
            partial(errors_in_frame, plan_flight(settings, seed)),
            range(settings.frames),
            jobs=jobs,
            start=cv2.setNumThreads,
            start_arguments=(0,),
        )
    )
    errors = np.array([each for of_frame, _ in found for each in of_frame]).reshape(-1, 3)
    relative, distance, centre = errors.T
    seconds = float(np.median([each for _, each in found]))
    return RingErrors(relative, distance, centre, seconds)


@click.command()
@click.option("--size", type=click.Choice(list(SIZES)), default="small", show_default=True)
@click.option(
    "--camera",
    "cameras",
    type=click.Choice(list(_CAMERAS)),
    multiple=True,
    default=("clean", "consumer"),
    show_default=True,
    help="One or more cameras.",
)
@click.option(
    "--frames", type=click.IntRange(2), default=60, show_default=True, help="Frames per line."
)
@click.option("--quality", type=click.IntRange(1, 100), default=None, help="Quality of JPEG.")
@click.option(
    "--astigmatism", type=click.FloatRange(1.0, 5.0), default=1.0, help="As kgcp simulate."
)
@click.option("--coma", type=click.FloatRange(0.0, 0.2), default=0.0, help="As kgcp simulate.")
@click.option(
    "--defocus", type=click.FloatRange(0.0, 10.0), default=0.0, help="As kgcp simulate [px]."
)
@click.option("--seed", type=click.IntRange(0), default=77, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(
    size: str,
    cameras: tuple[str, ...],
    frames: int,
    quality: int | None,
    astigmatism: float,
    coma: float,
    defocus: float,
    seed: int,
    jobs: int | None,
) -> None:
    """Print the table."""
    aberration = Aberration(astigmatism=astigmatism, coma=coma, defocus_px=defocus)
    lens = None if aberration == Aberration() else aberration
    print(
        "camera       light                found  RMS [%]   z mean   z RMS  > 3  z of centre   ms"
    )
    for camera in cameras:
        for light in _LIGHTS:
            settings = settings_of(camera, light, frames, SIZES[size], quality)
            errors = errors_of(replace(settings, lens=lens), seed, jobs or usable_cores())
            z = errors.distance
            print(
                f"{camera:13s}{light:21s}{len(z):5d}{100.0 * rms(errors.relative):11.4f}"
                f"{z.mean():7.2f}{rms(z):8.2f}{np.count_nonzero(np.abs(z) > 3.0):5d}"
                f"{rms(errors.centre):13.2f}{1e3 * errors.seconds:5.0f}",
                flush=True,
            )


def rms(values: FloatArray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
