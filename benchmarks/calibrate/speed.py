"""Wall and CPU time of `kgcp calibrate` on photographs of 12 Mpx with 200 discs.

    python -m benchmarks.calibrate.speed [--photographs 20] [--jobs 2] [--response unknown]

The photographs are first rendered into a temporary folder, which is not timed. Wall time depends on
other work of the machine; CPU time hardly does, but may not include that of workers: measure it
with --jobs 0.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.io.flight.field_file import read_field
from kgcp.simulation.field_session import FieldSession, field_photograph, printed_points
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve

_FIELD = "asymmetric:8x25:20mm:14mm"  # 200 discs whose arrangement shows which way is up
_CAMERA = Camera(4000, 3000, 4100.0, 4100.0, 2012.0, 1489.0, -0.08, 0.05)
_LIMIT_S = 60.0  # on two cores


def write_photographs(folder: Path, count: int) -> None:
    """Render a session into a folder."""
    sensor = Sensor(tone=ToneCurve.SRGB)
    field = read_field(_FIELD)
    session = FieldSession(_CAMERA, field, count, Optics(0.8), sensor, 0.9, has_edges=False)
    rng = np.random.default_rng(12)
    points = printed_points(session, rng)
    for number in range(session.photographs):
        taken = field_photograph(session, points, number, rng)
        cv2.imwrite(str(folder / f"photo{number:02}.jpg"), taken.grey)


def main() -> None:
    """Print wall and CPU time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photographs", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--response", choices=("linear", "srgb", "unknown"), default="unknown")
    parser.add_argument(
        "--folder", type=Path, help="folder that keeps the photographs, to reuse them the next time"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary) / "photographs"
        if not folder.is_dir():
            folder.mkdir(parents=True)
            write_photographs(folder, arguments.photographs)
        command = [sys.executable, "-m", "kgcp", "calibrate", str(folder), "--field", _FIELD]
        command += ["--out", str(Path(temporary) / "out"), "--jobs", str(arguments.jobs)]
        command += ["--response", arguments.response]
        before, began_s = os.times(), time.perf_counter()
        subprocess.run(command, check=True)
        wall_s, after = time.perf_counter() - began_s, os.times()
    own_s = after.children_user - before.children_user
    system_s = after.children_system - before.children_system
    count = arguments.photographs
    print(
        f"{count} photographs: {wall_s:.1f} s, CPU {own_s + system_s:.1f} s"
        f" ({(own_s + system_s) / count:.2f} s each); goal {_LIMIT_S * count / 20:.0f} s"
    )


if __name__ == "__main__":
    main()
