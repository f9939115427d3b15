"""Poses of frames from points, some of which have wrong names: share of right poses, and z.

There is one line per number of points, with and without distances from the sizes of the images. A
pose is right if χ² of its errors is within what chance allows. The last line is for EO devices.

With `--readout`, a rolling shutter reads the frames while the camera turns and shifts. Both motions
make the scene turn at rates with the standard deviation `motion_sd_deg_s`. The pose is that of the
middle row.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.network.ground.device import orient_by_device
from kgcp.network.ground.point_images import CameraPose, PointImages, Readout
from kgcp.network.ground.resection import NoPoseError, orient
from kgcp.pipeline.execution.threads import use_one_thread_each

_CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 803.2, 596.1, k1=-0.05)
_HEIGHT_M = 30.0
_SD_PX, _SD_POSITION_M, _SD_DISTANCE = 0.05, 0.005, 5e-4
_WRONG = 0.3  # share of wrong names
_RIGHT_CHI2 = 50.0  # limit for six numbers; chance exceeds it once in a hundred million times
_POINTS = (3, 4, 5, 6, 8, 12, 20, 30)
_LEAST_RIGHT = 0.999
_NUMBERS = re.compile(r"\d+(\.\d+)?")
_SD_FOCAL, _LEAST_DEVICES = 0.2, 0.995

DEVICE_M: FloatArray = np.array(
    [[0.0, 0.0, 0.0], [0.30, 0.0, 0.0], [0.05, 0.22, 0.0], [0.26, 0.19, 0.0], [0.14, 0.08, 0.12]]
)
"""Four points in a plane and one above it, without symmetry."""


@dataclass(frozen=True, slots=True)
class Setup:
    """One line of the table."""

    points: int
    has_distance: bool
    frames: int
    seed: int
    readout_s: float = 0.0

    @property
    def camera(self) -> Camera:
        """The camera, with its readout time."""
        return replace(_CAMERA, readout_s=self.readout_s)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Results of the frames of one setup."""

    setup: Setup
    refused: Counter[str]  # frames by reason, without the numbers in it
    wrong: int
    z: FloatArray  # (n, 6): standardised errors of right poses

    @property
    def right_share(self) -> float:
        """Share of right poses among all poses."""
        given = len(self.z) + self.wrong
        return len(self.z) / given if given else math.nan


def _true_pose(rng: np.random.Generator) -> CameraPose:
    off, azimuth = math.radians(rng.uniform(0.0, 30.0)), rng.uniform(0.0, 2.0 * math.pi)
    centre = _HEIGHT_M * np.array(
        [math.sin(off) * math.cos(azimuth), math.sin(off) * math.sin(azimuth), math.cos(off)]
    )
    z = -centre / _HEIGHT_M
    x = np.cross(z, [0.0, 1.0, 0.2])
    x /= np.linalg.norm(x)
    turn = rotation_about(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))
    return CameraPose(centre, np.column_stack((x, np.cross(z, x), z)) @ turn)


def _scene(setup: Setup, rng: np.random.Generator) -> tuple[CameraPose, PointImages]:
    """Draw a random frame: points on nearly flat or rough ground, some with wrong names."""
    count, pose = setup.points, _true_pose(rng)
    places = np.column_stack(
        (
            rng.uniform(-9.0, 9.0, count),
            rng.uniform(-6.5, 6.5, count),
            rng.normal(0.0, rng.choice([0.05, 1.0]), count),
        )
    )
    true = places + rng.normal(0.0, _SD_POSITION_M, places.shape)
    in_camera = _seen(setup.camera, pose, true, rng)
    pixels = _CAMERA.project(in_camera) + rng.normal(0.0, _SD_PX, (count, 2))
    distance = np.linalg.norm(in_camera, axis=1) * (1.0 + rng.normal(0.0, _SD_DISTANCE, count))
    names = np.arange(count)
    bad = rng.choice(count, int(_WRONG * count), replace=False)
    if len(bad) == 1:
        names[bad[0]] = rng.choice(np.setdiff1d(names, bad))
    else:
        names[bad] = np.roll(bad, 1)
    unknown = np.full(count, np.nan)
    images = PointImages(
        places[names],
        np.repeat(_SD_POSITION_M**2 * np.eye(3)[None], count, axis=0),
        pixels,
        np.repeat(_SD_PX**2 * np.eye(2)[None], count, axis=0),
        distance if setup.has_distance else unknown,
        _SD_DISTANCE * distance if setup.has_distance else unknown,
        readout=Readout.of(setup.camera, pixels),
    )
    return pose, images


def _seen(
    camera: Camera, pose: CameraPose, points_m: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return points (n, 3) in the camera frame, each at the time of its row."""
    seen = pose.in_camera(points_m)
    if not camera.readout_s:
        return seen
    sd_rad_s = math.radians(camera.motion_sd_deg_s)
    motion = rng.normal(0.0, np.repeat([sd_rad_s * _HEIGHT_M, sd_rad_s], 3))
    for _ in range(3):  # the row depends on the motion
        delay_s = camera.delay_s(camera.project(seen))
        seen = np.vstack(
            [
                pose.moved(each_s * motion).in_camera(point[None])
                for each_s, point in zip(delay_s.tolist(), points_m, strict=True)
            ]
        )
    return seen


def measure(setup: Setup) -> Outcome:
    """Orient frames of one setup."""
    rng = np.random.default_rng([setup.seed, setup.points, setup.has_distance])
    refused: Counter[str] = Counter()
    wrong, z = 0, []
    for _ in range(setup.frames):
        truth, images = _scene(setup, rng)
        try:
            found = orient(setup.camera, images)
        except NoPoseError as refusal:
            refused[_NUMBERS.sub("#", str(refusal))] += 1
            continue
        turn = found.pose.world_from_camera @ truth.world_from_camera.T
        odd = 0.5 * (turn - turn.T)
        error = np.array([*(found.pose.centre_m - truth.centre_m), odd[2, 1], odd[0, 2], odd[1, 0]])
        if error @ np.linalg.solve(found.cov, error) < _RIGHT_CHI2:
            z.append(error / np.sqrt(np.diag(found.cov)))
        else:
            wrong += 1
    return Outcome(setup, refused, wrong, np.array(z).reshape(-1, 6))


def line(outcome: Outcome) -> str:
    """Return the outcome in words."""
    setup = outcome.setup
    kind = "places and distances" if setup.has_distance else "places alone"
    if not len(outcome.z):
        verdict = f", {outcome.wrong} wrong  MISSED" if outcome.wrong else ""
        return f"{setup.points:2d} points, {kind}: {outcome.refused.total()} refused{verdict}"
    z = np.sqrt(np.mean(outcome.z**2, axis=0))
    is_reached = outcome.right_share >= _LEAST_RIGHT and 0.9 <= float(np.sqrt(np.mean(z**2))) <= 1.1
    return (
        f"{setup.points:2d} points, {kind}: right {100 * outcome.right_share:.2f} % of"
        f" {len(outcome.z) + outcome.wrong}, {outcome.refused.total()} refused, z"
        f" {' '.join(f'{each:.2f}' for each in z)}{'' if is_reached else '  MISSED'}"
    )


def total_line(outcomes: Sequence[Outcome]) -> str:
    """Return the share of right poses in all frames, in words."""
    right = sum(len(outcome.z) for outcome in outcomes)
    wrong = sum(outcome.wrong for outcome in outcomes)
    refused = sum((outcome.refused for outcome in outcomes), Counter())
    reasons = "".join(f"\n  {count} {reason}" for reason, count in refused.most_common())
    share = right / max(right + wrong, 1)
    z = np.vstack([outcome.z for outcome in outcomes])
    is_reached = share >= _LEAST_RIGHT
    return (
        f"all: right {100 * share:.2f} % of {right + wrong} poses, {wrong} wrong, {refused.total()}"
        f" frames refused, z {' '.join(f'{each:.2f}' for each in np.sqrt(np.mean(z**2, axis=0)))}"
        f"{'' if is_reached else '  MISSED'}{reasons}"
    )


def measure_devices(count: int, seed: int = 0) -> str:
    """Orient cameras, whose focal length is known to 20 %, by a device of five points.

    Returns
    -------
    str
        A line of text.
    """
    rng = np.random.default_rng([seed, 5])
    camera = Camera(1600, 1200, 2300.0, 2300.0, 799.5, 599.5)
    right = refused = wrong = 0
    margins = []
    for _ in range(count):
        truth = _true_pose(rng)
        middle = DEVICE_M.mean(axis=0)
        distance = rng.uniform(0.8, 2.0)
        pose = CameraPose(
            middle + distance / _HEIGHT_M * truth.centre_m,
            truth.world_from_camera,
            math.exp(rng.normal(0.0, _SD_FOCAL)),
        )
        points = pose.in_camera(DEVICE_M)
        pixels = camera.distort(pose.focal_scale * points[:, :2] / points[:, 2:])
        order = rng.permutation(len(DEVICE_M))
        pixels = (pixels + rng.normal(0.0, _SD_PX, pixels.shape))[order]
        cov = np.repeat(_SD_PX**2 * np.eye(2)[None], len(pixels), axis=0)
        try:
            found = orient_by_device(camera, DEVICE_M, pixels, cov, sd_focal=_SD_FOCAL)
        except NoPoseError:
            refused += 1
            continue
        margins.append(found.margin)
        if np.array_equal(found.names, order):
            right += 1
        else:
            wrong += 1
    verdict = "" if right >= _LEAST_DEVICES * count else "  MISSED"
    return (
        f"device of 5 points, focal length ± 20 %: right permutation in"
        f" {100 * right / count:.2f} % of {count}, {wrong} wrong, {refused} refused, margin"
        f" {min(margins):.1f} at least, {np.median(margins):.0f} in the middle{verdict}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per number of points."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--frames", type=int, default=300, help="frames per line")
    parser.add_argument("--points", type=int, nargs="*", default=_POINTS)
    parser.add_argument(
        "--readout", type=float, default=0.0, help="readout time of a rolling shutter [s]"
    )
    parser.add_argument("--devices", type=int, default=400, help="frames with an EO device")
    options = parser.parse_args(arguments)
    setups = [
        Setup(points, has_distance, options.frames, 0, options.readout)
        for has_distance, points in itertools.product((True, False), options.points)
    ]
    outcomes = []
    for outcome in ordered_map(
        measure, setups, jobs=options.jobs, start=use_one_thread_each, start_arguments=()
    ):
        print(line(outcome), flush=True)
        outcomes.append(outcome)
    print(total_line(outcomes), flush=True)
    if options.devices:
        print(measure_devices(options.devices), flush=True)


if __name__ == "__main__":
    main()
