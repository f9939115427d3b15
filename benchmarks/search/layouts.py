"""Which layouts of targets the search finds: rings of other widths, with wider or more dots.

Usage: python -m benchmarks.search.layouts [--count 12] [--seed 1] [--small-dots]

Each line is for a ratio of inner to outer diameter of the ring; each column is for a number of dots
and for their diameter divided by the width of the ring. The targets have random codes, radii of 12
to 70 px and tilts of up to 35 degrees, one in each frame. kgcp's own targets have a ratio of 0.5
and 3 to 6 dots of 0.57.
"""

from __future__ import annotations

import click
import cv2
import numpy as np

from benchmarks.search.plates import plate_of
from benchmarks.search.scene import (
    Shot,
    Veil,
    pixel_inside,
    place,
    random_camera,
    render,
    scene_around,
    stream,
)
from kgcp.errors import SettingError
from kgcp.measurement.frame import examine
from kgcp.measurement.records import Measurement
from kgcp.settings import DetectSettings
from kgcp.simulation.imaging import Optics
from kgcp.targets.code_design import dots_apart_turned
from kgcp.targets.layout import Ring, Target

_RATIOS = (0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75)
_DOTS = ((4, 0.35), (4, 0.57), (4, 0.75), (6, 0.35), (6, 0.57), (6, 0.75))
_SMALL_DOTS = tuple((dots, share) for dots in (4, 10) for share in (0.15, 0.2, 0.25, 0.3, 0.35))
_DIAMETER_M = 0.9
_RADIUS_PX, _TILT_DEG = (12.0, 70.0), (0.0, 35.0)
_PSF_PX, _GAIN = 0.7, 0.85
_MAX_ERROR = 0.02  # largest distance between measured and true place, relative to the distance
_ATTEMPTS = 2000
_LEAST_APART = 1.0  # least difference of a code from itself rotated [dots]


def random_target(
    ratio: float, dots: int, dot_share: float, rng: np.random.Generator
) -> Target | None:
    """Return a target of this layout with a random code; None if the dots do not fit."""
    code_m = 0.5 * (1.0 + ratio) * _DIAMETER_M
    dot_m = 0.5 * dot_share * (1.0 - ratio) * _DIAMETER_M
    for _ in range(_ATTEMPTS):
        code_deg = tuple(rng.integers(0, 360, dots).astype(float).tolist())
        try:
            ring = Ring("A", _DIAMETER_M, ratio * _DIAMETER_M, code_m, dot_m, code_deg)
        except SettingError:  # dots touch
            continue
        if dots_apart_turned(ring) > _LEAST_APART:
            return Target(ring)
    return None


def is_found(target: Target, seed: int, index: int, rng: np.random.Generator) -> bool:
    """Render the target in a frame and tell whether it is measured at its true place."""
    camera, chain = random_camera(rng)
    radius_px = float(np.exp(rng.uniform(*np.log(_RADIUS_PX))))
    pixel = pixel_inside(camera, radius_px, rng)
    seen = place(camera, plate_of(target, rng), pixel, radius_px, _TILT_DEG, rng)
    optics = Optics(_PSF_PX)
    shot = Shot(camera, chain, scene_around(seen, (), rng), (seen,), (), (), optics, _GAIN, Veil())
    grey = render(shot, seed, stream(seed, "layouts", index, "pixels"))
    outcomes = examine(grey, camera, (target,), DetectSettings()).outcomes
    limit_m = _MAX_ERROR * seen.pose.distance_m
    return any(
        isinstance(outcome, Measurement)
        and np.linalg.norm(outcome.pose.translation_m - seen.pose.translation_m) < limit_m
        for outcome in outcomes
    )


@click.command()
@click.option(
    "--count", type=click.IntRange(1), default=12, show_default=True, help="Frames per layout."
)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@click.option("--small-dots", is_flag=True, help="Layouts with smaller dots instead.")
def main(count: int, seed: int, *, small_dots: bool) -> None:
    """Print the share of targets that is found for each layout."""
    cv2.setNumThreads(0)
    layouts = _SMALL_DOTS if small_dots else _DOTS
    print(f"found [%] of {count} by layout; -: the dots do not fit on the ring")
    print("ratio " + "".join(f"{dots:4d} x {share:.2f}" for dots, share in layouts), flush=True)
    for ratio in _RATIOS:
        cells = []
        for dots, share in layouts:
            targets = []
            for index in range(count):
                rng = stream(seed, f"{ratio} {dots} {share}", index, "plan")
                targets.append((random_target(ratio, dots, share, rng), index, rng))
            if any(target is None for target, _, _ in targets):
                cells.append(f"{'-':>11s}")
                continue
            found = [is_found(t, seed, i, rng) for t, i, rng in targets if t is not None]
            cells.append(f"{100.0 * np.mean(found):11.0f}")
        print(f"{ratio:5.2f} " + "".join(cells), flush=True)


if __name__ == "__main__":
    main()
