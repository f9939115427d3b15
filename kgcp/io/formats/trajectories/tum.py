"""Trajectories in the notation of TUM's benchmarks: `timestamp tx ty tz qx qy qz qw`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import level_axes_ecef, map_axes_ecef
from kgcp.georef.trajectory import ENU_FROM_NED
from kgcp.io.files.safe_read import is_sound, read_lines
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions, check_times
from kgcp.io.formats.trajectories.times import times_from_texts

_CELLS = 8
_MAX_NORM_ERROR = 1e-3


def matches(file: ForeignFile) -> bool:
    """Whether the first line has eight cells."""
    return len(file.first_line.split()) == _CELLS


def read(file: ForeignFile, options: TrajectoryFileOptions, flight_crs: str) -> Epochs:
    """Read poses R(map ← body), t in the map, of a body with x forward, y right, z down."""
    path = file.path
    lines, texts, numbers = _read_rows(file)
    time_s = times_from_texts(path, lines, texts, options)
    check_times(path, time_s, lambda row: f"line {lines[row]}")
    crs = options.crs or flight_crs
    position = numbers[:, :3]
    norms = np.linalg.norm(numbers[:, 3:], axis=1)
    not_unit = np.flatnonzero(np.abs(norms - 1.0) > _MAX_NORM_ERROR)
    if not_unit.size:
        raise KgcpError(
            f"{path}, line {lines[not_unit[0]]}: its quaternion has the norm"
            f" {norms[not_unit[0]]:g}; write timestamp tx ty tz qx qy qz qw with a unit quaternion"
        )
    attitude_deg = None
    if options.course_sd_deg is None:
        attitude_deg = _attitude_deg(crs, position, numbers[:, 3:])
        _refuse_upside_down(path, attitude_deg)
    return Epochs(time_s, crs, position, attitude_deg)


def _read_rows(file: ForeignFile) -> tuple[list[int], list[str], FloatArray]:
    lines, texts, numbers = [], [], []
    for line, row in enumerate(read_lines(file.path, file.toml_key), start=1):
        cells = row.split()
        if not cells or cells[0].startswith("#"):
            continue
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = []
        if len(values) != _CELLS or not all(map(is_sound, values)):
            raise file.error_at(
                f"line {line}",
                "is not the eight numbers timestamp tx ty tz qx qy qz qw",
                "repair the line",
            )
        lines.append(line)
        texts.append(cells[0])
        numbers.append(values[1:])
    return lines, texts, np.reshape(np.array(numbers), (-1, _CELLS - 1))


def _attitude_deg(crs: str, position: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Return roll, pitch and true heading (n, 3) [deg] of rotations against the map's axes."""
    map_from_body = Rotation.from_quat(quaternions).as_matrix()
    level = level_axes_ecef(crs, position)
    level_from_body = np.swapaxes(level, -1, -2) @ map_axes_ecef(crs, position) @ map_from_body
    ned_from_body = Rotation.from_matrix(ENU_FROM_NED.T @ level_from_body)
    heading, pitch, roll = ned_from_body.as_euler("ZYX", degrees=True).T
    return np.column_stack((roll, pitch, heading % 360.0))


def _refuse_upside_down(path: Path, attitude_deg: FloatArray) -> None:
    if np.median(np.abs(attitude_deg[:, 0])) > 90.0:
        raise KgcpError(
            f"{path}: by its quaternions the vehicle drives on its roof; body axes are x forward,"
            " y right, z down: from x forward, y left, z up write (qw, qz, -qy, -qx) in the places"
            " of (qx, qy, qz, qw)"
        )
