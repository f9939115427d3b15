"""Errors of distances that are caused by a renderer with few samples per pixel.

Usage: python -m benchmarks.accuracy.sampling FLIGHT TRUTH [--samples 4] [--jobs 2]

The plate of every frame is rendered again at its true pose, sampled n × n times per pixel, with
linear response and hardly any noise, and measured. The resulting error is that of the renderer. The
error in the frame minus this error is that of the measurement. The table has three kinds of z: of
the errors as measured and of the differences, both divided by the reported standard deviations,
which do not include the renderer; and of the errors as measured, divided by standard deviations
that include the RMS error of the renderings in the same band.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import cv2
import numpy as np
import pandas as pd

from benchmarks.accuracy.bands import RADIUS_BANDS_PX, join_truth, read_truth
from benchmarks.accuracy.evaluate import detect
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.io.flight.flight import read_flight
from kgcp.measurement.image_model.plate import circles_of
from kgcp.measurement.records import Measurement
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Target

_BLACK, _WHITE = 10.0, 190.0  # grey values
_NOISE = 1.0  # standard deviation [grey values]; with less, rounding would cause a pattern
_REPEATS = 4
_MARGIN = 1.5  # half the width of the rendered window, in radii of the ring
_BAND_LIMITS_PX = sorted({limit for band in RADIUS_BANDS_PX for limit in band})


def sampled_error(camera: Camera, target: Target, row: pd.Series, samples: int) -> float:
    """Return the mean error of the distance [%] in renderings of a plate; NaN if not found."""
    elements = [f"r{i}{k}" for i in range(3) for k in range(3)]
    pose = Pose(
        row[elements].to_numpy(float).reshape(3, 3), row[["cx", "cy", "cz"]].to_numpy(float)
    )
    x0, y0, plate = rendered(camera, target, pose, row, samples)
    height, width = plate.shape
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(_REPEATS):
        grey = np.full((camera.height, camera.width), int(_WHITE), dtype=np.uint8)
        noisy = np.rint(plate + rng.normal(scale=_NOISE, size=plate.shape)).astype(np.uint8)
        grey[y0 : y0 + height, x0 : x0 + width] = noisy
        (seen,) = measure_frame(grey, camera, (target,), DetectSettings())
        if isinstance(seen, Measurement):
            errors.append(100.0 * (seen.pose.distance_m / pose.distance_m - 1.0))
    return float(np.mean(errors)) if errors else float("nan")


def rendered(
    camera: Camera, target: Target, pose: Pose, row: pd.Series, samples: int
) -> tuple[int, int, FloatArray]:
    """Return the first column and row of a window, and its pixels with the plate.

    The plate is sampled, blurred with the frame's PSF, and averaged over each pixel.
    """
    half = int(_MARGIN * row["radius_px_true"]) + 6
    low = np.maximum(np.rint([row["x"], row["y"]]).astype(int) - half, 0)
    high = np.minimum(low + 2 * half + 1, (camera.width, camera.height))
    columns, rows = (
        a - 0.5 + (np.arange((b - a) * samples) + 0.5) / samples
        for a, b in zip(low, high, strict=True)
    )
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = np.column_stack((camera.undistort(points), np.ones(len(points))))
    depth = (pose.normal @ pose.translation_m) / (rays @ pose.normal)
    on_plate = (depth[:, None] * rays - pose.translation_m) @ pose.rotation[:, :2]
    circles, share = circles_of(target.rings), np.ones(len(points))
    for centre_m, radius_m, sign in zip(
        circles.centres_m.T, circles.radii_m, circles.signs, strict=True
    ):
        share += sign * (np.sum((on_plate - centre_m) ** 2, axis=1) < radius_m**2)
    fine = (_BLACK + (_WHITE - _BLACK) * share).reshape(len(rows), len(columns))
    blurred = cv2.GaussianBlur(fine, (0, 0), samples * float(row["psf"]))
    shape = (high[1] - low[1], samples, high[0] - low[0], samples)
    return int(low[0]), int(low[1]), blurred.reshape(shape).mean(axis=(1, 3))


def lines(table: pd.DataFrame) -> Iterator[str]:
    """Yield mean, RMS and z for every band: of measured errors, renderings and differences."""
    yield (
        "      R px  frames   measured: mean, RMS %   rendering: mean, RMS %   left: mean, RMS %"
        "          z: measured  left  with renderer"
    )
    for low, high in (*RADIUS_BANDS_PX, (0.0, np.inf)):
        band = table[(table["radius_px_true"] >= low) & (table["radius_px_true"] < high)]
        if len(band) < 2:
            continue
        left = band["error_percent"] - band["rendering_percent"]
        parts = (band["error_percent"], band["rendering_percent"], left)
        figures = "  ".join(
            f"{part.mean():+.4f} ± {2.0 * part.std() / np.sqrt(len(part)):.4f} {_rms(part):.4f}"
            for part in parts
        )
        sd = 100.0 * band["sd_distance_m"] / band["distance_m"]
        measured, with_renderer = (
            band["error_percent"] / each for each in (sd, np.hypot(sd, band["renderer_percent"]))
        )
        yield (
            f"{low:6.0f}–{high:<4.0f}{len(band):6d}   {figures}"
            f"  {_rms(measured):11.2f}  {_rms(left / sd):4.2f}  {_rms(with_renderer):13.2f}"
        )


def _rms(errors: pd.Series) -> float:
    return float(np.sqrt((errors**2).mean()))


@click.command()
@click.argument("flight", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option("--samples", type=click.IntRange(1), default=4, show_default=True)
@click.option("--jobs", type=int, default=None)
def main(flight: Path, truth: Path, samples: int, jobs: int | None) -> None:
    """Print the table."""
    described = read_flight(flight)
    camera = replace(described.camera, response=Response.LINEAR)
    table = join_truth(detect(flight, DetectSettings(), jobs or usable_cores()), read_truth(truth))
    table = table[table["is_right"]].copy()
    table["rendering_percent"] = [
        sampled_error(camera, described.targets[0], row, samples) for _, row in table.iterrows()
    ]
    of_band = pd.cut(table["radius_px_true"], _BAND_LIMITS_PX, right=False)
    table["renderer_percent"] = table.groupby(of_band, observed=True)[
        "rendering_percent"
    ].transform(_rms)
    print(f"{flight}  {samples} × {samples} samples per pixel, means ± 2 standard errors")
    print("\n".join(lines(table)))


if __name__ == "__main__":
    main()
