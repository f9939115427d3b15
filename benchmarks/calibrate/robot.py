"""Comparison of the poses of a calibration with those of the robot that held the camera.

    python -m benchmarks.calibrate.robot FOLDER [--jobs 2]

FOLDER is ros10 of ros-industrial/industrial_calibration: photographs, cal_data.yaml, and the
robot's pose at every photograph in poses/. The pose of the camera on the robot and that of the
board are adjusted to both. The residuals are the positions of the board's corners by the
photographs minus those by the robot, in depth and across; the table has their RMS over corners and
photographs. The axes of the camera are weighted by their residuals. With equal weights, the
residuals in depth are some 0.5 mm larger.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from scipy import optimize
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.io.flight.field_file import read_field
from kgcp.measurement.discs.records import Operator
from kgcp.network.calibration import calibrate_camera
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    PointModel,
)
from kgcp.pipeline.calibration.run import CalibrationOptions, calibrate_photos, find_photos
from kgcp.pipeline.detect import NoProgress

_WEIGHTINGS = 4
_LIMIT_MM = 1.35  # of the RMS in depth, with the shape of the board estimated


def read_robot(folder: Path, names: list[str]) -> tuple[Rotation, FloatArray]:
    """Return rotations and positions [m] of the robot's wrist in its base, by photograph."""
    poses = [yaml.safe_load((folder / "poses" / f"{Path(n).stem}.yaml").read_text()) for n in names]
    turns = Rotation.from_quat([[pose[key] for key in ("qx", "qy", "qz", "qw")] for pose in poses])
    return turns, np.array([[pose[key] for key in "xyz"] for pose in poses])


def corner_errors_mm(calibration: CameraCalibration, folder: Path) -> FloatArray:
    """Return corners by the photographs minus by the robot (n, 3) [mm], in the camera's axes."""
    wrist, places = read_robot(folder, [view.photo for view in calibration.views])
    estimate = calibration.solution.estimate
    boards = Rotation.from_matrix(estimate.rotations)
    nominal = calibration.field.points_m()
    extent = nominal.sum(axis=1), nominal[:, 0] - nominal[:, 1]
    corners = estimate.points[[f(s) for s in extent for f in (np.argmin, np.argmax)]]
    seen = np.stack([board.apply(corners) for board in boards]) + estimate.translations[:, None]

    # rotations between photographs have the same axes, expressed in wrist and camera
    pairs = list(itertools.combinations(range(len(places)), 2))
    of_wrist = [(wrist[i].inv() * wrist[j]).as_rotvec() for i, j in pairs]
    of_camera = [(boards[i] * boards[j].inv()).as_rotvec() for i, j in pairs]
    camera, _ = Rotation.align_vectors(of_wrist, of_camera)
    base = (wrist[0] * camera * boards[0]).as_rotvec()

    def errors_m(unknowns: FloatArray) -> FloatArray:
        held, board = (Rotation.from_rotvec(unknowns[k : k + 3]) for k in (0, 6))
        in_base = board.apply(corners) + unknowns[9:]
        by_robot = [
            held.inv().apply(turn.inv().apply(in_base - place) - unknowns[3:6])
            for turn, place in zip(wrist, places, strict=True)
        ]
        return (seen - np.stack(by_robot)).reshape(-1, 3)

    board_m = wrist[0].apply(camera.apply(estimate.translations[0])) + places[0]
    start = np.concatenate((camera.as_rotvec(), np.zeros(3), base, board_m))

    def weighted(unknowns: FloatArray, scales: FloatArray) -> FloatArray:
        return np.asarray((errors_m(unknowns) / scales).ravel())

    scales = np.ones(
        3
    )  # the camera's axes have different errors: each is weighted by its residuals
    for _ in range(_WEIGHTINGS):
        start = optimize.least_squares(weighted, start, x_scale="jac", args=(scales,)).x
        scales = np.sqrt(np.mean(errors_m(start) ** 2, axis=0))
    return 1e3 * errors_m(start)


def main() -> None:
    """Print a line for the board as stated, and one for the board with its estimated shape."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    field = read_field(str(chosen.folder / "cal_data.yaml"))
    options = CalibrationOptions(
        CalibrationSettings(), Response.UNKNOWN, Operator.MODEL, chosen.jobs
    )
    with tempfile.TemporaryDirectory() as out:
        photos = find_photos([chosen.folder])
        first = calibrate_photos(photos, field, Path(out), options, NoProgress()).calibration
    size = (first.camera.width, first.camera.height)
    for points in (PointModel.FIXED, PointModel.FREE):
        settings = replace(first.settings, points=points, lens=LensModel.BROWN)
        calibration = calibrate_camera(first.views, first.field, size, settings, first)
        x, y, depth = np.sqrt(np.mean(corner_errors_mm(calibration, chosen.folder) ** 2, axis=0))
        print(
            f"{points.value:6} f {calibration.camera.fx:7.2f} px  "
            f"depth {depth:.2f} mm, across {np.hypot(x, y):.2f} mm",
            flush=True,
        )
    sys.exit(0 if depth <= _LIMIT_MM else 1)


if __name__ == "__main__":
    main()
