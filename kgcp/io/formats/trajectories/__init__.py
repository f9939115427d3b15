"""Readers of the target carrier's trajectory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.course import attitude_from_course
from kgcp.georef.crs import convert_positions
from kgcp.georef.local_frame import map_axes_ecef, turn_covariances
from kgcp.georef.trajectory import Trajectory
from kgcp.io.files.safe_read import require_file
from kgcp.io.formats.rtklib_pos import looks_like_solution
from kgcp.io.formats.trajectories.csv import read_csv
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFormat, TrajectoryNotation
from kgcp.io.formats.trajectories.rtklib import read_rtklib
from kgcp.io.formats.trajectories.sbet import looks_like_sbet, read_sbet
from kgcp.io.formats.trajectories.tum import read_tum

__all__ = ["TrajectoryFormat", "TrajectoryNotation", "read_trajectory", "recognise"]

_HEAD = 4096
_KEY = "[vehicle] trajectory"
_CONTRACT = TrajectoryNotation()


def read_trajectory(
    path: Path, flight_crs: str, notation: TrajectoryNotation = _CONTRACT
) -> Trajectory:
    """Read the vehicle's trajectory, in any of the formats of docs/conventions.md.

    Parameters
    ----------
    path : Path
    flight_crs : str
        CRS of the flight, for pyproj: that of the result.
    notation : TrajectoryNotation
        What flight.toml says about the file.

    Raises
    ------
    KgcpError
        Naming file and line: it is missing, of no known format or wrong, its times lack a day or
        a time system, its positions have no way to the flight's CRS, or there is no attitude.
    """
    kind = notation.format or recognise(path)
    _refuse_foreign_keys(kind, notation)
    epochs = _read(path, kind, notation, flight_crs)
    if epochs.crs != flight_crs:
        epochs = _on_map(path, epochs, flight_crs)
    attitude_deg, sd_attitude_deg = epochs.attitude_deg, epochs.sd_attitude_deg
    if notation.course_sd_deg is not None:
        attitude_deg = attitude_from_course(str(path), epochs.time_s, epochs.position, flight_crs)
        sd_attitude_deg = np.tile(notation.course_sd_deg, (len(epochs.time_s), 1))
    if attitude_deg is None:
        raise KgcpError(
            f"{path}: has no attitude, which turns the lever arm; give a trajectory with attitude,"
            ' or under [vehicle] in flight.toml attitude = "course" and sd_attitude_deg ='
            " [2, 2, 3] (what you think of roll, pitch and heading)"
        )
    return Trajectory(
        epochs.time_s,
        epochs.position,
        attitude_deg,
        epochs.sd_position_m,
        sd_attitude_deg,
        epochs.cov_position_m2,
    )


def recognise(path: Path) -> TrajectoryFormat:
    """Tell the format of a trajectory by its content.

    Raises
    ------
    KgcpError
        If the file is missing, empty, or of no known format.
    """
    require_file(path, _KEY)
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise KgcpError(f"{path}: {error.strerror}; make it readable") from error
    if not head.strip():
        raise KgcpError(f"{path}: is empty; give a trajectory")
    if looks_like_sbet(head, path.stat().st_size):
        return TrajectoryFormat.SBET
    if looks_like_solution(head):
        return TrajectoryFormat.RTKLIB
    first = _first_line(head)
    if "," in first:
        return TrajectoryFormat.CSV
    if len(first.split()) == 8:
        return TrajectoryFormat.TUM
    raise KgcpError(
        f"{path}: is none of the known formats ({', '.join(TrajectoryFormat)}); give one of them,"
        " and its name as [vehicle] format in flight.toml to see what is wrong with it"
    )


def _first_line(head: bytes) -> str:
    """Return the first line that is no comment; nothing for what is not text."""
    if b"\0" in head:
        return ""
    rows = head.decode("utf-8-sig", errors="replace").splitlines()
    return next((row for row in rows if row.strip() and not row.startswith("#")), "")


def _refuse_foreign_keys(kind: TrajectoryFormat, notation: TrajectoryNotation) -> None:
    given = {
        "accuracies": notation.accuracies_file is not None and kind is not TrajectoryFormat.SBET,
        "wander": notation.wander is not None and kind is not TrajectoryFormat.SBET,
        "date": notation.first_day is not None and kind is TrajectoryFormat.RTKLIB,
        "time_system": notation.time_system is not None and kind is TrajectoryFormat.RTKLIB,
    }
    for key, foreign in given.items():
        if foreign:
            raise KgcpError(
                f"flight.toml: [vehicle] {key}: has no meaning with a trajectory of format"
                f" {kind.value}; delete it, or correct format"
            )


def _read(
    path: Path, kind: TrajectoryFormat, notation: TrajectoryNotation, flight_crs: str
) -> Epochs:
    match kind:
        case TrajectoryFormat.SBET:
            return read_sbet(path, notation)
        case TrajectoryFormat.RTKLIB:
            return read_rtklib(path, notation)
        case TrajectoryFormat.TUM:
            return read_tum(path, notation, flight_crs)
        case TrajectoryFormat.CSV:
            return read_csv(path, notation, flight_crs)


def _on_map(path: Path, epochs: Epochs, crs: str) -> Epochs:
    """Bring positions, and what is given along the axes, to the flight's CRS."""
    position = convert_positions(str(path), epochs.position, epochs.crs, crs)
    cov = epochs.cov_position_m2
    if cov is None and epochs.sd_position_m is not None:
        cov = _diagonal(epochs.sd_position_m**2)
    if cov is None:
        return replace(epochs, crs=crs, position=position)
    axes = map_axes_ecef(epochs.crs, epochs.position), map_axes_ecef(crs, position)
    cov = turn_covariances(cov, *axes)
    sd_position_m = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return replace(
        epochs, crs=crs, position=position, sd_position_m=sd_position_m, cov_position_m2=cov
    )


def _diagonal(variances: FloatArray) -> FloatArray:
    matrices: FloatArray = variances[:, :, None] * np.eye(3)
    return matrices
