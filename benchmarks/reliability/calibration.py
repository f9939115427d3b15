"""Kill `kgcp calibrate` and its workers at random moments, and repeat it until it is complete.

All files must be, byte for byte, those of an undisturbed run, which in turn must not depend on the
number of jobs. Linux only, because it finds the workers in /proc.
"""

from __future__ import annotations

import hashlib
import random
import sys
import tempfile
import time
from pathlib import Path

import click
import cv2
import numpy as np

from benchmarks.reliability.torture import Life, torture
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.io.flight.field_file import field_toml
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, photograph
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.targets.fields.layout import Field, GridKind, Mark

_CAMERA = Camera(640, 480, 620.0, 620.0, 322.4, 236.1, -0.08)
_FIELD = Field("f", GridKind.SQUARE, 8, 6, 0.03, 0.016, marks=(Mark(1, 1, 0.016, 0.007),))
_DISTANCE_M = 0.33
_JOBS = (0, 1, 2)


def make_photos(folder: Path, count: int) -> Path:
    """Write photographs of a field from all sides, and its field.toml; return the latter."""
    folder.mkdir()
    discs = tuple(
        SimulatedDisc(tuple(point), 2.0 * radius, 2.0 * inner)
        for point, radius, inner in zip(
            _FIELD.points_m().tolist(),
            _FIELD.radii_m().tolist(),
            _FIELD.inner_radii_m().tolist(),
            strict=True,
        )
    )
    middle = _FIELD.points_m().mean(axis=0)
    for index in range(count):
        rng = np.random.default_rng(index)
        tilt = 0.5 * np.array([np.cos(2.4 * index), np.sin(2.4 * index), 0.0])
        turn = rotation_about(np.array([0.0, 0.0, 0.5 * np.pi * (index % 2)]))
        rotation = rotation_about(tilt) @ turn
        shift = np.array([*(0.02 * rng.standard_normal(2)), _DISTANCE_M])
        pose = Pose(rotation, shift - rotation @ middle)
        grey = photograph(_CAMERA, pose, FieldScene(discs), Optics(0.6), Sensor(), rng)
        cv2.imwrite(str(folder / f"photo{index}.png"), grey)
    field = folder / "field.toml"
    field.write_text(field_toml(_FIELD), encoding="utf-8")
    return field


def calibrating(photos: Path, field: Path, out: Path, jobs: int) -> list[str]:
    """Return the arguments of kgcp to calibrate the camera."""
    options = ["--field", str(field), "--out", str(out), "--jobs", str(jobs), "--format", "opencv"]
    return ["calibrate", str(photos), *options]


def hashes(out: Path) -> dict[str, str]:
    """Return the hash of every file, including hidden files."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def _finish(command: list[str]) -> None:
    life = Life(command)
    if life.end() != 0:
        raise RuntimeError("".join(life.lines[-20:]))


@click.command()
@click.option("--photos", "count", type=click.IntRange(6), default=40, show_default=True)
@click.option("--kills", type=click.IntRange(0), default=20, show_default=True)
@click.option("--seed", type=int, default=1, show_default=True)
def main(count: int, kills: int, seed: int) -> None:
    """Print a line per run, and exit with 1 if any wrote other bytes."""
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder) / "photos"
        field = make_photos(photos, count)
        runs = {}
        for jobs in _JOBS:
            out = Path(folder) / f"jobs{jobs}"
            _finish(calibrating(photos, field, out, jobs))
            runs[f"{jobs} jobs"] = hashes(out)
        out = Path(folder) / "tortured"
        start_s = time.perf_counter()
        rng = random.Random(seed)  # noqa: S311 - no secret
        toll = torture(calibrating(photos, field, out, _JOBS[-1]), out, kills, rng)
        tortured_s = time.perf_counter() - start_s
        runs[
            f"killed {toll.parents} times, and {toll.workers} workers, in {tortured_s:.0f} s"
            f" (complete runs: {toll.runs})"
        ] = hashes(out)
    first = next(iter(runs.values()))
    for name, each in runs.items():
        print(f"{name}: {len(each)} files, {'the same' if each == first else 'OTHER'} bytes")
    sys.exit(any(each != first for each in runs.values()))


if __name__ == "__main__":
    main()
