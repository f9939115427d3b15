"""Errors of a flight in realistic light, compared with the bound of its frames and with chance.

Usage: python -m benchmarks.accuracy.disturbed FLIGHT TRUTH [--levels 0.006 0.03] [--skew]
           [--jpeg 93]

For every measured frame, the Cramér-Rao bound (`kgcp.simulation.crlb`) is computed for the camera
of the simulators, twice: with the unknowns of even light alone, and with additional unknowns for
the disturbances of light, lens and processing, see `disturbances`. The blur is the measured one.
The noise is that of the sensor and, with --jpeg, of the compression. The bound does not allow for
the loss of light by shade and stains, or for noise reduction: it is still a bound, but one for
better frames than these.

Beside the errors of each band, the table has the intervals that 95 % of sets of so few frames reach
by chance: for the RMS error, if the error of every frame has the standard deviation of its bound;
and for z, if the reported standard deviations are right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import click
import cv2
import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter
from scipy.sparse import csc_array, diags_array, hstack
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from benchmarks.accuracy.bands import RADIUS_BANDS_PX, join_truth, read_truth
from benchmarks.accuracy.evaluate import detect
from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.io.flight.flight import read_flight
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.execution.threads import use_one_thread_each
from kgcp.settings import DetectSettings
from kgcp.simulation.crlb import Equations, Shot, equations_of, pose_bound, propagated
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve

_SHARPEST_PX2 = 0.09  # least variance of the point spread, without that of the pixel
_MASK_PX = 1.2  # σ of the sharpening mask
_STEP_PX2 = 0.02  # step for the derivative by smoothing along contours
_SMOOTHING_SD_PX2 = 0.05  # of a frame's smoothing about that of its camera, which is known
_KNOTS_PX, _KNOTS_PER_RADIUS = 8.0, 6.0  # lattice of the levels: least spacing, knots per radius
_DRAWS, _CHANCE = 20_000, (0.025, 0.975)
_LEAST_FRAMES = 3
_EXPOSURES = 8  # noisy frames from which the effect of compression is estimated
# limits of classes of pixels by their share of white
_BANDS = np.array([-0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 1.01])


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Disturbances of a flight that the bound treats as unknown."""

    # standard deviations of the levels of ink and of plate from place to place, relative to the
    # contrast; 0: they are even
    levels_sd: tuple[float, float]
    has_skew: bool  # whether the point spread may be asymmetric
    jpeg_quality: int | None  # None: frames are not compressed


def disturbances(equations: Equations, *, has_skew: bool) -> Iterator[FloatArray]:
    """Yield the derivatives (height, width) of the irradiance by the unknown disturbances.

    These are the third parameter of the tone curve, elongations of the point spread, the gradient
    of the light, sharpening after and before the tone curve, and the third cumulants of the point
    spread. None has a prior, so that their scales do not matter.
    """
    share, view = equations.share, equations.view
    shot = view.shot
    light = view.irradiance(share)
    grey = shot.sensor.tone.apply(shot.gain * light)
    slope = shot.sensor.tone.slope(shot.gain * light)
    yield share * (1.0 - share) * (2.0 * share - 1.0) ** 2 / slope
    by_y, by_x = np.gradient(equations.white)
    (by_xy, by_xx), (by_yy, _) = np.gradient(by_x), np.gradient(by_y)
    spread = [by_xx - by_yy, by_xy]
    if has_skew:
        (by_xxy, by_xxx), (by_yyy, by_xyy) = np.gradient(by_xx), np.gradient(by_yy)
        spread += [by_xxx, by_xxy, by_xyy, by_yyy]
    for each in spread:
        yield view.seen(each, shot.optics)
    rows, columns = np.indices(share.shape)
    yield light * (columns / share.shape[1] - 0.5)
    yield light * (rows / share.shape[0] - 0.5)
    yield (grey - gaussian_filter(grey, _MASK_PX)) / slope
    yield share - gaussian_filter(share, _MASK_PX)


def by_smoothing(equations: Equations) -> FloatArray:
    """Return the derivative (height, width) of the white share by smoothing along contours [px²].

    A circle with a radius of r px shrinks by 1 / (2 r) px.
    """
    shot = equations.view.shot
    ring = shot.plate.target.ring
    px_per_m = _px_per_m(shot)

    def shrunk(diameter_m: float, square_px2: float) -> float:
        radius_px = 0.5 * diameter_m * px_per_m
        return diameter_m * (1.0 - 0.5 * square_px2 / radius_px**2)

    def seen(square_px2: float) -> FloatArray:
        smaller = replace(
            ring,
            outer_diameter_m=shrunk(ring.outer_diameter_m, square_px2),
            inner_diameter_m=shrunk(ring.inner_diameter_m, square_px2),
            dot_diameter_m=shrunk(ring.dot_diameter_m, square_px2),
        )
        target = replace(shot.plate.target, ring=smaller)
        view = replace(equations.view, shot=replace(shot, plate=replace(shot.plate, target=target)))
        return view.seen(view.white(shot.pose), shot.optics)

    return (seen(_STEP_PX2) - seen(-_STEP_PX2)) / (2.0 * _STEP_PX2)


def _px_per_m(shot: Shot) -> float:
    return float(shot.camera.mean_focal_px / shot.pose.translation_m[2])


def levels_of(equations: Equations, levels_sd: tuple[float, float]) -> csc_array:
    """Return the derivatives (n, k) by the levels of ink and plate at the knots of a lattice.

    The levels are in units of their standard deviations times the contrast; between knots, they are
    interpolated bilinearly.
    """
    share, shot = equations.share, equations.view.shot
    radius_px = 0.5 * shot.plate.target.ring.outer_diameter_m * _px_per_m(shot)
    spacing = max(_KNOTS_PX, radius_px / _KNOTS_PER_RADIUS)
    across = int(share.shape[1] / spacing) + 2
    rows, columns = (each.ravel() / spacing for each in np.indices(share.shape))
    row, column = rows.astype(int), columns.astype(int)
    down, right = rows - row, columns - column
    corners = (
        (row * across + column, (1.0 - down) * (1.0 - right)),
        (row * across + column + 1, (1.0 - down) * right),
        ((row + 1) * across + column, down * (1.0 - right)),
        ((row + 1) * across + column + 1, down * right),
    )
    knots, parts = (np.concatenate(each) for each in zip(*corners, strict=True))
    pixels = np.tile(np.arange(share.size), 4)
    size = share.size, int(knots.max()) + 1
    at_knots = csc_array((parts, (pixels, knots)), shape=size)
    of_ink, of_plate = (
        diags_array(sd * part.ravel()) @ at_knots
        for sd, part in zip(levels_sd, (1.0 - share, share), strict=True)
    )
    return csc_array(hstack((of_ink, of_plate)))


def weight_left(equations: Equations, quality: int) -> FloatArray:
    """Return the factors (n,) by which JPEG reduces the weights of pixels, from noisy frames.

    They follow from the mean square change by compression, by the pixels' share of white: pixels at
    edges change most.
    """
    share, shot = equations.share, equations.view.shot
    rng, light = np.random.default_rng(1), equations.view.irradiance(share)
    ideal = shot.sensor.develop(np.clip(shot.gain * light, 0.0, 1.0))
    squares = np.zeros((2, share.size))
    for _ in range(_EXPOSURES):
        frame = shot.sensor.expose(light, shot.gain, rng)
        coded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        seen = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
        squares += [((each - ideal) ** 2).ravel() for each in (frame, seen)]
    band = np.digitize(share.ravel(), _BANDS) - 1
    before, after = (np.bincount(band, each, len(_BANDS) - 1) for each in squares)
    return np.asarray(np.sqrt(before / np.maximum(after, before))[band])


def disturbed_bound(shot: Shot, disturbance: Disturbance) -> tuple[float, float]:
    """Return the bounds of the distance [%]: in even light, and with the disturbances.

    The levels, which have a prior, are eliminated: N = Xᵀ X − Xᵀ L (Lᵀ L + 1)⁻¹ Lᵀ X.
    """
    equations = equations_of(shot)
    if disturbance.jpeg_quality is not None:
        left = weight_left(equations, disturbance.jpeg_quality)
        equations = replace(
            equations,
            weight=equations.weight * left,
            pose=equations.pose * left[:, None],
            nuisances=equations.nuisances * left[:, None],
        )
    weight = equations.weight
    even = propagated(shot, pose_bound(equations.pose, equations.nuisances))
    more = [
        each.ravel() * weight for each in disturbances(equations, has_skew=disturbance.has_skew)
    ]
    contrast = shot.plate.white - shot.plate.black
    smoothing = contrast * by_smoothing(equations).ravel() * weight
    fixed = np.column_stack((equations.pose, equations.nuisances, *more, smoothing))
    sizes = np.linalg.norm(fixed, axis=0)
    fixed = fixed[:, sizes > 0.0] / sizes[sizes > 0.0]
    weighted = fixed
    if any(disturbance.levels_sd):
        levels = diags_array(weight * contrast) @ levels_of(equations, disturbance.levels_sd)
        own = csc_array(levels.T @ levels + diags_array(np.ones(levels.shape[1])))
        weighted = fixed - levels @ splu(own).solve(levels.T @ fixed)
    information = fixed.T @ weighted
    information[-1, -1] += (_SMOOTHING_SD_PX2 * sizes[-1]) ** -2
    covariance = np.linalg.inv(information)[:6, :6] / np.outer(sizes[:6], sizes[:6])
    return even.distance_percent, propagated(shot, covariance).distance_percent


def shot_of(camera: Camera, row: pd.Series) -> Shot:
    """Return the view of the simulator's target, from a joined row of truth and measurement."""
    elements = [f"r{i}{k}" for i in range(3) for k in range(3)]
    rotation = row[elements].to_numpy(float).reshape(3, 3)
    is_linear = camera.response is Response.LINEAR
    return Shot(
        camera=camera,
        plate=TARGET_PLATE,
        pose=Pose(rotation, row[["cx", "cy", "cz"]].to_numpy(float)),
        optics=Optics(math.sqrt(max(float(row["blur_px"]) ** 2 - 1.0 / 12.0, _SHARPEST_PX2))),
        sensor=Sensor(tone=ToneCurve.LINEAR if is_linear else ToneCurve.SRGB),
        gain=float(row["gain"]),
        has_unknown_streak=False,
    )


def _bounds_in_worker(task: tuple[Shot, Disturbance]) -> tuple[float, float]:
    return disturbed_bound(*task)


def chance_of_rms(deviations: FloatArray) -> FloatArray:
    """Return the 95 % interval (2,) of the RMS of errors with these standard deviations."""
    errors = np.random.default_rng(1).standard_normal((_DRAWS, len(deviations))) * deviations
    return np.asarray(np.quantile(np.sqrt(np.mean(errors**2, axis=1)), _CHANCE))


def chance_of_z(count: int) -> FloatArray:
    """Return the 95 % interval (2,) of the RMS of a number of standardised errors."""
    return np.asarray(np.sqrt(chi2.ppf(_CHANCE, count) / count))


def lines(table: pd.DataFrame) -> Iterator[str]:
    """Yield a header, a line for each band that has some frames, and one for all frames."""
    yield (
        "      R px  frames  error %   bound %: even  disturbed (RMS by chance)"
        "   / bound  z distance (by chance)  z centre (by chance)"
    )
    for low, high in (*RADIUS_BANDS_PX, (0.0, math.inf)):
        band = table[(table["radius_px_true"] >= low) & (table["radius_px_true"] < high)]
        if len(band) < _LEAST_FRAMES:
            continue
        disturbed, count = band["disturbed_percent"].to_numpy(float), len(band)
        ratio = band["error_percent"].to_numpy(float) / disturbed
        rms, z, centre = chance_of_rms(disturbed), chance_of_z(count), chance_of_z(2 * count)
        yield (
            f"{low:5.0f}\u2013{high:<5.0f}{count:6d}  {_rms(band['error_percent']):7.4f}"
            f"  {_rms(band['even_percent']):13.4f}  {_rms(disturbed):9.4f}"
            f" ({rms[0]:.4f}\u2013{rms[1]:.4f})  {_rms(ratio):8.2f}"
            f"  {_rms(band['z_distance']):10.2f} ({z[0]:.2f}\u2013{z[1]:.2f})"
            f"  {_rms(band['z_centre']):9.2f} ({centre[0]:.2f}\u2013{centre[1]:.2f})"
        )


def _rms(values: pd.Series | FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@click.command()
@click.argument("flight", type=click.Path(path_type=Path))
@click.argument("truth", type=click.Path(path_type=Path))
@click.option(
    "--levels",
    type=click.FloatRange(0.0, 1.0),
    nargs=2,
    default=(0.0, 0.0),
    help="Standard deviations of the levels of ink and plate, relative to the contrast; 0: even.",
)
@click.option("--skew", is_flag=True, help="The point spread may be asymmetric.")
@click.option(
    "--jpeg", type=click.IntRange(1, 100), default=None, help="JPEG quality of the frames."
)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(
    flight: Path,
    truth: Path,
    levels: tuple[float, float],
    jpeg: int | None,
    jobs: int | None,
    *,
    skew: bool,
) -> None:
    """Print the table."""
    jobs = jobs or usable_cores()
    camera = read_flight(flight).camera
    table = join_truth(detect(flight, DetectSettings(), jobs), read_truth(truth))
    table = table[table["is_right"]].copy()
    disturbance = Disturbance(levels, skew, jpeg)
    tasks = [(shot_of(camera, row), disturbance) for _, row in table.iterrows()]
    bounds = ordered_map(
        _bounds_in_worker, tasks, jobs=jobs, start=use_one_thread_each, start_arguments=()
    )
    table[["even_percent", "disturbed_percent"]] = np.array(list(bounds))
    spread = "skew" if skew else "symmetric"
    print(f"{flight}  levels {levels[0]:g} {levels[1]:g}, {spread} point spread")
    print("\n".join(lines(table)))


if __name__ == "__main__":
    main()
