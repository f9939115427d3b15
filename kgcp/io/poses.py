"""Readers of the camera's reference poses."""

from __future__ import annotations

from pathlib import Path

from kgcp.errors import KgcpError
from kgcp.geometry.reference import ReferencePoses
from kgcp.io.csvcolumns import read_csv_columns

_POSITION = ("x", "y", "z")
_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_SD_POSITION = ("sd_x", "sd_y", "sd_z")
_SD_ANGLE = ("sd_angle_deg",)


def read_reference_poses(path: Path) -> ReferencePoses:
    """Read reference poses from a CSV file by docs/conventions.md.

    Columns frame, x, y, z, omega_deg, phi_deg, kappa_deg and, optionally, sd_x, sd_y, sd_z and
    sd_angle_deg, in any order.

    Raises
    ------
    KgcpError
        Naming the line: missing file or columns, values that are not finite, a frame twice.
    """
    columns = read_csv_columns(
        path, "frame", (*_POSITION, *_ANGLES), (*_SD_POSITION, *_SD_ANGLE), "[reference] poses"
    )
    frames = tuple(key.replace("\\", "/") for key in columns.keys)
    first_lines: dict[str, int] = {}
    for line, frame in zip(columns.lines, frames, strict=True):
        if frame in first_lines:
            raise KgcpError(
                f"{path}, line {line}: frame {frame!r} stands in line {first_lines[frame]} too;"
                " keep one of them"
            )
        first_lines[frame] = line
    sd_angle = columns.deviations(_SD_ANGLE)
    return ReferencePoses(
        frames=frames,
        position_map=columns.block(_POSITION),
        opk_deg=columns.block(_ANGLES),
        sd_position_m=columns.deviations(_SD_POSITION),
        sd_angle_deg=None if sd_angle is None else sd_angle[:, 0],
    )
