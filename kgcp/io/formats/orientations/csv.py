"""Reference poses in the columns of docs/foreign_files.md."""

from __future__ import annotations

from kgcp.geometry.attitude import rotation_from_opk
from kgcp.io.files.csv_columns import read_csv_columns
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import SourcePoses

_POSITION = ("x", "y", "z")
_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_SD_POSITION = ("sd_x", "sd_y", "sd_z")
_SD_ANGLE = ("sd_angle_deg",)


def matches(file: ForeignFile) -> bool:
    """Whether the first line names columns."""
    return "," in file.first_line and file.document is None and file.root is None


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in the flight's CRS.

    Columns frame, x, y, z, omega_deg, phi_deg, kappa_deg and, optionally, sd_x, sd_y, sd_z and
    sd_angle_deg, in any order.
    """
    columns = read_csv_columns(
        file.path,
        ("frame",),
        (*_POSITION, *_ANGLES),
        (*_SD_POSITION, *_SD_ANGLE),
        file.toml_key,
    )
    sd_angle = columns.deviations(_SD_ANGLE)
    return SourcePoses(
        names=columns.frames(),
        position=columns.block(_POSITION),
        frame_from_photo=rotation_from_opk(columns.block(_ANGLES)),
        sd_position_m=columns.deviations(_SD_POSITION),
        sd_angle_deg=None if sd_angle is None else sd_angle[:, 0],
        has_our_names=True,
    )
