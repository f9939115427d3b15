"""Input of a reader of trajectories from flight.toml, and its result: the file's epochs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date
from enum import StrEnum
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.io.files.csv_columns import CsvLayout
from kgcp.io.files.gps_time import TimeSystem

_MIN_ROUNDED, _ROUNDED_SHARE = 5, 0.2  # equal times, from which on they may have been rounded


class Wander(StrEnum):
    """How the wander angle of an SBET record turns its heading into the true one."""

    IGNORE = "ignore"
    SUBTRACT = "subtract"
    ADD = "add"


@dataclass(frozen=True, slots=True)
class TrajectoryFileOptions:
    """The keys of [vehicle] about its trajectory's file."""

    format: str | None = None  # its name; None: the content tells
    crs: str | None = None  # of the file's positions, for pyproj; None: the format's default
    time_system: TimeSystem | None = None  # of the file's times; None: the format's default
    # day on which the trajectory begins, by its own clock; if given, the file's times are seconds
    # of the week
    first_day: date | None = None
    accuracies_file: Path | None = None  # with SBET: smrmsg file of its standard deviations
    # with SBET: what to do with the wander angle; None: it has to be zero
    wander: Wander | None = None
    # if given, the attitude is level along the course over ground, with these standard deviations
    # of roll, pitch and heading; None: the file has the attitude
    course_sd_deg: tuple[float, float, float] | None = None
    layout: CsvLayout = field(default_factory=CsvLayout)  # with CSV: how its table is written

    @property
    def has_layout(self) -> bool:
        """Whether flight.toml says how the table of a CSV file is written."""
        return self.layout != CsvLayout()


@dataclass(frozen=True, slots=True, eq=False)
class Epochs:
    """A trajectory in the coordinates of its file."""

    time_s: FloatArray  # (n,): Unix time, UTC, strictly ascending, n ≥ 2 [s]
    crs: str  # of the positions, for pyproj
    # (n, 3): x = easting or longitude, y = northing or latitude, z, in the units of `crs`
    position: FloatArray
    # (n, 3): roll, pitch, heading against the local level and true north [deg]; None: not in the
    # file
    attitude_deg: FloatArray | None
    # (n, 3): standard deviations along the axes of `crs` [m]
    sd_position_m: FloatArray | None = None
    # (n, 3, 3): covariances along the axes of `crs` [m²], if the file has more than deviations
    cov_position_m2: FloatArray | None = None
    sd_attitude_deg: FloatArray | None = None  # (n, 3): of roll, pitch, heading [deg]


def valid_covariances(written: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) as a file has them, with negative eigenvalues set to 0.

    The rounding of its numbers can make a matrix that is not a covariance.
    """
    values, vectors = np.linalg.eigh(written)
    if values.min() >= 0.0:
        return written
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, -1, -2))


def check_times(path: Path, time_s: FloatArray, place: Callable[[int], str]) -> None:
    """Refuse fewer than two epochs, or times that do not ascend.

    `place` names the place of an epoch in the file, for the message.
    """
    if len(time_s) < 2:
        raise KgcpError(f"{path}: has {len(time_s)} epochs; interpolation needs at least two")
    not_later = np.flatnonzero(np.diff(time_s) <= 0.0)
    if not_later.size:
        row = int(not_later[0]) + 1
        repeated = int(np.count_nonzero(np.diff(time_s) == 0.0))
        if repeated == len(not_later) and repeated >= max(
            _MIN_ROUNDED, _ROUNDED_SHARE * len(time_s)
        ):
            raise KgcpError(
                f"{path}, {place(row)}: the time repeats that of {place(row - 1)}, as do"
                f" {repeated} of {len(time_s)} times; if they have been rounded, as spreadsheets"
                " do, export the file again with fractions of a second, or make a flight folder of"
                " each vehicle if they are of several"
            )
        problem = "repeats" if time_s[row] == time_s[row - 1] else "lies before"
        raise KgcpError(
            f"{path}, {place(row)}: the time {problem} that of {place(row - 1)}, by"
            f" {time_s[row - 1] - time_s[row]:g} s; sort the epochs and keep one of each, or make a"
            " flight folder of each vehicle if they are of several"
        )
