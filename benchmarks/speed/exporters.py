"""Wall time of writing many KGCPs in all formats.

Usage: python -m benchmarks.speed.exporters [--points 10000]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.formats import FORMATS
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export

LIMIT_S = 30.0
_START = np.array([430606.0, 4583523.0, 122.0])
_CAMERA = Camera(width=1600, height=1201, fx=2300.0, fy=2310.0, cx=801.3, cy=597.2, k1=-0.08)


def corridor(count: int) -> MapPoints:
    """Return points at steps of 10 m along a corridor, each with a camera prior of its frame."""
    rng = np.random.default_rng(1)
    places = _START + np.outer(np.arange(count), [1.0, 0.5, 0.01])
    gcps = tuple(
        Gcp(
            id=f"K{number:04d}",
            frame=f"IMG_{number:05d}.JPG",
            target="A",
            time_s=1777887000.0 + 0.1 * number,
            position_map=place,
            cov_m2=np.diag([4e-4, 4e-4, 9e-4]),
            centre_px=rng.uniform(0.0, [1600.0, 1201.0]),
            centre_cov_px2=np.diag([9e-4, 4e-4]),
            distance_m=78.0,
            sd_distance_m=0.01,
            sd_common_distance_m=None,
        )
        for number, place in enumerate(places, start=1)
    )
    attitude, cov = np.diag([1.0, -1.0, -1.0]), 1e-3 * np.eye(6)
    priors = tuple(
        CameraPrior(point.frame, point.position_map + np.array([0.0, 0.0, 78.0]), attitude, cov)
        for point in gcps
    )
    return MapPoints("EPSG:25831", gcps, _CAMERA, priors)


def time_formats(count: int) -> dict[str, float]:
    """Return the wall time of every format [s]."""
    points = corridor(count)
    times_s = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in FORMATS:
            begin_s = time.perf_counter()
            export(points, name, Path(folder))
            times_s[name] = time.perf_counter() - begin_s
    return times_s


def main() -> None:
    """Print the times; fail if all formats together take too long."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000)
    count = parser.parse_args().points
    begin_s = time.process_time()
    times_s = time_formats(count)
    cpu_s = time.process_time() - begin_s
    for name, seconds in times_s.items():
        print(f"{name:14s} {seconds:7.2f} s")
    total_s = sum(times_s.values())
    print(
        f"{'all formats':14s} {total_s:7.2f} s for {count} points, {cpu_s:.2f} s of CPU"
        f" (limit {LIMIT_S:g} s)"
    )
    if total_s > LIMIT_S:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
