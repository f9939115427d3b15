"""Readers of the vehicle's trajectory, one module per format.

Each module has one line in `FORMATS` and offers two functions. `matches(file)` says whether the
content has its format, `read(file, options, flight_crs)` returns its epochs. `read` raises
`KgcpError`, which names line or record, if a file does not follow its format or flight.toml lacks a
key.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.georef.crs import convert_positions
from kgcp.georef.local_frame import map_axes_ecef, turn_covariances
from kgcp.georef.trajectory import Trajectory, attitude_from_course
from kgcp.io.files.csv_columns import SEPARATOR_REMEDY
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.registry import Registry
from kgcp.io.formats.rtklib_pos import looks_like_solution
from kgcp.io.formats.trajectories import csv, rtklib, sbet, tum, waypoint
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions
from kgcp.io.formats.waypoint_export import looks_like_waypoint

FORMATS: Registry[Callable[[ForeignFile, TrajectoryFileOptions, str], Epochs]] = Registry(
    "a trajectory",
    "give one of them, and its name as [vehicle] format in flight.toml to see what is wrong",
    {
        "sbet": (sbet.matches, sbet.read),
        "rtklib": (looks_like_solution, rtklib.read),
        "waypoint": (looks_like_waypoint, waypoint.read),
        "csv": (csv.matches, csv.read),
        "tum": (tum.matches, tum.read),
    },
    "declare separator, decimal and columns under [vehicle], as 'kgcp init' does, or"
    f" {SEPARATOR_REMEDY}",
)
_DEFAULT_OPTIONS = TrajectoryFileOptions()


def read_trajectory(
    path: Path, flight_crs: str, options: TrajectoryFileOptions = _DEFAULT_OPTIONS
) -> Trajectory:
    """Read the vehicle's trajectory, in one of the `FORMATS` of docs/foreign_files.md.

    Parameters
    ----------
    flight_crs : str
        CRS of the flight, for pyproj: that of the result.

    Raises
    ------
    KgcpError
        If the file is missing, of no known format or wrong, its times lack a day or a time system,
        its CRS cannot be transformed exactly to the flight's, or it has no attitude. The message
        names file and line.
    """
    file = ForeignFile(path, "[vehicle] trajectory")
    if not file.head.strip():
        raise file.error("is empty", "give a trajectory")
    form = options.format or ("csv" if options.has_layout else FORMATS.recognised(file))
    _refuse_foreign_keys(form, options)
    epochs = FORMATS.reader(file, form)(file, options, flight_crs)
    if epochs.crs != flight_crs:
        epochs = _on_map(path, epochs, flight_crs)
    attitude_deg, sd_attitude_deg = epochs.attitude_deg, epochs.sd_attitude_deg
    if options.course_sd_deg is not None:
        attitude_deg = attitude_from_course(str(path), epochs.time_s, epochs.position, flight_crs)
        sd_attitude_deg = np.tile(options.course_sd_deg, (len(epochs.time_s), 1))
    if attitude_deg is None:
        raise KgcpError(
            f"{path}: has no attitude, which turns the lever arm; give a trajectory with attitude,"
            ' or under [vehicle] in flight.toml attitude = "course" and sd_attitude_deg ='
            " [2, 2, 3] (your estimates for roll, pitch and heading)"
        )
    return Trajectory(
        epochs.time_s,
        epochs.position,
        attitude_deg,
        epochs.sd_position_m,
        sd_attitude_deg,
        epochs.cov_position_m2,
        form,
    )


def _refuse_foreign_keys(form: str, options: TrajectoryFileOptions) -> None:
    given = {
        "accuracies": options.accuracies_file is not None and form != "sbet",
        "wander": options.wander is not None and form != "sbet",
        "date": options.first_day is not None and form == "rtklib",
        "time_system": options.time_system is not None and form == "rtklib",
        "separator, decimal or columns": options.has_layout and form != "csv",
    }
    for key, is_foreign in given.items():
        if is_foreign:
            raise KgcpError(
                f"flight.toml: [vehicle] {key}: has no meaning with a trajectory of format"
                f" {form}; delete it, or correct format"
            )


def _on_map(path: Path, epochs: Epochs, crs: str) -> Epochs:
    """Transform positions and their covariances to the flight's CRS."""
    time_s = float(epochs.time_s[0])
    position = convert_positions(str(path), epochs.position, epochs.crs, crs, time_s)
    cov = epochs.cov_position_m2
    if cov is None and epochs.sd_position_m is not None:
        cov = epochs.sd_position_m[:, :, None] ** 2 * np.eye(3)
    if cov is None:
        return replace(epochs, crs=crs, position=position)
    axes = map_axes_ecef(epochs.crs, epochs.position), map_axes_ecef(crs, position)
    cov = turn_covariances(cov, *axes)
    sd_position_m = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return replace(
        epochs, crs=crs, position=position, sd_position_m=sd_position_m, cov_position_m2=cov
    )
