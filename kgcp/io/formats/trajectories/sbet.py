"""Applanix's smoothed best estimate of trajectory (SBET), and its accuracies (smrmsg).

By POSPac MMS's export formats: both are records of little-endian doubles without any header, so
that a file states neither its day nor its time system. Angles of SBET are radians. The heading is
that of the platform in the wander frame, unless the export has corrected it. Programs differ in
this, hence [vehicle] wander. Standard deviations of smrmsg are metres (north before east) and arc
minutes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import WGS84_3D
from kgcp.io.files.gps_time import unwrap_week
from kgcp.io.files.safe_read import LARGEST, read_bytes
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.trajectories.records import Epochs, TrajectoryFileOptions, Wander, check_times
from kgcp.io.formats.trajectories.times import times_from_week

_RECORD = 17  # time, latitude, longitude, height, 3 velocities, roll, pitch, heading, wander, …
_ACCURACY = 10  # time, sd of north, east, down, of 3 velocities, of roll, pitch, heading
_DOUBLE = 8
_ARC_MINUTES_PER_DEGREE = 60.0
_MAX_BYTES = (1 << 30) - 1  # ten hours at 200 Hz
_MAX_WANDER_RAD = 1e-6
_TINY = 1e-12  # zeros, and other bytes read as doubles, are smaller


def matches(file: ForeignFile) -> bool:
    """Whether the size is that of whole records, and the first holds possible values."""
    record = _RECORD * _DOUBLE
    if len(file.head) < record or file.path.stat().st_size % record:
        return False
    values = np.frombuffer(file.head, dtype="<f8", count=_RECORD)
    if not np.isfinite(values).all():
        return False
    seconds, latitude, longitude, height = values[:4]
    is_plausible = -86400.0 < seconds < 3e6 and abs(height) < 1e5
    is_on_earth = _TINY < abs(latitude) <= np.pi / 2.0 and _TINY < abs(longitude) <= 2.0 * np.pi
    return bool(is_plausible and is_on_earth)


def read(file: ForeignFile, options: TrajectoryFileOptions, _flight_crs: str) -> Epochs:
    """Read records of 17 little-endian doubles: seconds of the week, radians, metres.

    Standard deviations are those of the smrmsg file, if flight.toml names one.
    """
    path = file.path
    records = _read_records(path, _RECORD, file.toml_key)
    _check_values(path, records)
    seconds = records[:, 0]
    time_s = times_from_week(path, seconds, options)
    check_times(path, time_s, lambda row: f"record {row + 1}")
    sd_position_m, sd_attitude_deg = None, None
    if options.accuracies_file is not None:
        sd_position_m, sd_attitude_deg = _read_accuracies(options.accuracies_file, seconds)
    return Epochs(
        time_s=time_s,
        crs=options.crs or WGS84_3D,
        position=np.column_stack((np.degrees(records[:, [2, 1]]), records[:, 3])),
        attitude_deg=_attitude_deg(path, records, options.wander),
        sd_position_m=sd_position_m,
        sd_attitude_deg=sd_attitude_deg,
    )


def first_record(path: Path) -> FloatArray:
    """Return the values (17,) of the first record."""
    with path.open("rb") as stream:
        return np.frombuffer(stream.read(_RECORD * _DOUBLE), dtype="<f8").astype(float)


def _read_records(path: Path, columns: int, toml_key: str) -> FloatArray:
    data = read_bytes(path, toml_key, _MAX_BYTES)
    size = columns * _DOUBLE
    if not data or len(data) % size:
        raise KgcpError(
            f"{path}: has {len(data)} bytes, not a multiple of {size} bytes per record;"
            " it is cut or of another format: export it again"
        )
    return np.asarray(np.frombuffer(data, dtype="<f8").reshape(-1, columns).astype(float))


def _check_values(path: Path, records: FloatArray) -> None:
    is_finite = (np.abs(records[:, [0, 1, 2, 3, 7, 8, 9, 10]]) < LARGEST).all(axis=1)
    is_on_earth = (np.abs(records[:, 1]) <= np.pi / 2.0) & (np.abs(records[:, 2]) <= 2.0 * np.pi)
    invalid = np.flatnonzero(~(is_finite & is_on_earth))
    if invalid.size:
        time, latitude, longitude, height = records[invalid[0], :4]
        raise KgcpError(
            f"{path}, record {invalid[0] + 1}: time {time:g}, latitude {latitude:g} rad, longitude"
            f" {longitude:g} rad, height {height:g} m is impossible; the file is damaged or of"
            " another format: export it again"
        )


def _attitude_deg(path: Path, records: FloatArray, wander: Wander | None) -> FloatArray:
    roll, pitch, heading, angle = records[:, 7:11].T
    if wander is None and np.abs(angle).max() > _MAX_WANDER_RAD:
        raise KgcpError(
            f"{path}: has wander angles up to {np.degrees(np.abs(angle).max()):.4f} deg; say under"
            ' [vehicle] in flight.toml how the true heading follows: wander = "subtract" if the'
            ' headings are the platform\'s, "ignore" if they are true ones already, or "add"'
        )
    sign = {Wander.SUBTRACT: -1.0, Wander.ADD: 1.0}.get(wander or Wander.IGNORE, 0.0)
    attitude = np.column_stack((roll, pitch, (heading + sign * angle) % (2.0 * np.pi)))
    return np.asarray(np.degrees(attitude))


def _read_accuracies(path: Path, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations of east, north, up [m] and roll, pitch, heading [deg] at these seconds."""
    records = _read_records(path, _ACCURACY, "[vehicle] accuracies")
    accuracy_s, epoch_s = unwrap_week(records[:, 0]), unwrap_week(seconds)
    steps = np.diff(accuracy_s)
    if len(accuracy_s) < 2 or steps.min() <= 0.0:
        raise KgcpError(f"{path}: its times do not ascend; export it again")
    margin = steps.max()
    if epoch_s[0] < accuracy_s[0] - margin or epoch_s[-1] > accuracy_s[-1] + margin:
        raise KgcpError(
            f"{path}: covers the seconds {accuracy_s[0]:g} to {accuracy_s[-1]:g}, the trajectory"
            f" {epoch_s[0]:g} to {epoch_s[-1]:g}; give the accuracies of this trajectory"
        )
    deviations = records[:, [2, 1, 3, 7, 8, 9]]
    if not np.isfinite(deviations).all() or deviations.min() < 0.0:
        raise KgcpError(
            f"{path}: holds standard deviations that are negative or not finite; export it again"
        )
    at_epochs = np.column_stack([np.interp(epoch_s, accuracy_s, column) for column in deviations.T])
    return at_epochs[:, :3], at_epochs[:, 3:] / _ARC_MINUTES_PER_DEGREE
