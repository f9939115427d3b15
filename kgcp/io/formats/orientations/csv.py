"""Reference poses in the columns of docs/foreign_files.md."""

from __future__ import annotations

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import rotation_from_opk
from kgcp.io.files.csv_columns import CsvColumns, read_csv_columns
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.orientations.records import SourcePoses

_POSITION = ("x", "y", "z")
_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_SD_POSITION = ("sd_x", "sd_y", "sd_z")
_SD_ANGLE = ("sd_angle_deg",)

_PARAMETERS = (*_POSITION, "rot_x", "rot_y", "rot_z")
_ROWS, _COLUMNS = np.triu_indices(len(_PARAMETERS))
COVARIANCE_COLUMNS = tuple(
    f"cov_{_PARAMETERS[row]}_{_PARAMETERS[column]}"
    for row, column in zip(_ROWS.tolist(), _COLUMNS.tolist(), strict=True)
)
"""Columns of a pose's covariance, its upper triangle: position [m], left rotation vector [rad]."""
_COVARIANCE_WORDS = f"{COVARIANCE_COLUMNS[0]} to {COVARIANCE_COLUMNS[-1]}"

# Tolerances of rounded cells: relative, of standard deviations [m or deg], and of the smallest
# eigenvalue of the matrix of correlations.
_SD_TOLERANCE, _ROUNDED_SD, _LEAST_EIGENVALUE = 0.01, 2e-6, -1e-5


def covariance_cells(cov: FloatArray) -> list[str]:
    """Return a pose's covariance (6, 6) as cells of `COVARIANCE_COLUMNS`."""
    return [f"{value:.9e}" for value in cov[_ROWS, _COLUMNS].tolist()]


def matches(file: ForeignFile) -> bool:
    """Whether the first line names columns."""
    return "," in file.first_line and file.document is None and file.root is None


def poses(file: ForeignFile) -> SourcePoses:
    """Return the poses, in the flight's CRS.

    Columns frame, x, y, z, omega_deg, phi_deg, kappa_deg and, optionally, sd_x, sd_y, sd_z,
    sd_angle_deg and `COVARIANCE_COLUMNS`, in any order.
    """
    columns = read_csv_columns(
        file.path,
        ("frame",),
        (*_POSITION, *_ANGLES),
        (*_SD_POSITION, *_SD_ANGLE, *COVARIANCE_COLUMNS),
        file.toml_key,
    )
    sd_position, sd_angle = columns.deviations(_SD_POSITION), columns.deviations(_SD_ANGLE)
    cov = _covariances(columns)
    if cov is not None:
        sds = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        by_cov = sds[:, :3], np.degrees(np.sqrt(np.mean(sds[:, 3:] ** 2, axis=1, keepdims=True)))
        _require_agreement(columns, _SD_POSITION, sd_position, by_cov[0])
        _require_agreement(columns, _SD_ANGLE, sd_angle, by_cov[1])
        sd_position, sd_angle = by_cov
    return SourcePoses(
        names=columns.frames(),
        position=columns.block(_POSITION),
        frame_from_photo=rotation_from_opk(columns.block(_ANGLES)),
        sd_position_m=sd_position,
        sd_angle_deg=None if sd_angle is None else sd_angle[:, 0],
        cov=cov,
        has_our_names=True,
    )


def _covariances(columns: CsvColumns) -> FloatArray | None:
    """Return the covariances (n, 6, 6); None if the file has none."""
    cells = columns.optional_block(COVARIANCE_COLUMNS)
    if cells is None:
        return None
    cov = np.zeros((len(cells), 6, 6))
    cov[:, _ROWS, _COLUMNS] = cov[:, _COLUMNS, _ROWS] = cells
    variances = np.diagonal(cov, axis1=1, axis2=2)
    sds = np.sqrt(np.maximum(variances, 0.0))
    scale = np.where(sds > 0.0, sds, 1.0)
    correlations = cov / scale[:, :, None] / scale[:, None, :]
    is_wrong = (variances < 0.0).any(axis=1)
    is_wrong |= np.linalg.eigvalsh(correlations)[:, 0] < _LEAST_EIGENVALUE
    if is_wrong.any():
        line = columns.lines[int(np.argmax(is_wrong))]
        raise KgcpError(
            f"{columns.path}, line {line}: {_COVARIANCE_WORDS} are no covariance; if a"
            " spreadsheet has rounded them, take the file as it was written"
        )
    return cov


def _require_agreement(
    columns: CsvColumns, names: tuple[str, ...], sds: FloatArray | None, by_cov: FloatArray
) -> None:
    """Raise `KgcpError` if standard deviations are not those of the covariances."""
    if sds is None:
        return
    wrong = np.argwhere(np.abs(sds - by_cov) > _ROUNDED_SD + _SD_TOLERANCE * by_cov)
    if wrong.size:
        row, column = wrong[0].tolist()
        raise KgcpError(
            f"{columns.path}, line {columns.lines[row]}: {names[column]} is {sds[row, column]:g},"
            f" but {by_cov[row, column]:g} by {_COVARIANCE_WORDS}; make both agree, or, if a"
            " spreadsheet has rounded them, take the file as it was written"
        )
