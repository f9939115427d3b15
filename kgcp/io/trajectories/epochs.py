"""A trajectory as its file has it, before it is brought to the flight's map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Epochs:
    """A trajectory in the coordinates of its file.

    Attributes
    ----------
    time_s : (n,) array
        Unix time, UTC, strictly ascending, n ≥ 2 [s].
    crs : str
        Of the positions, for pyproj.
    position : (n, 3) array
        x = easting or longitude, y = northing or latitude, z, in the units of `crs`.
    attitude_deg : (n, 3) array or None
        Roll, pitch, heading against the local level and true north [deg]; None: not in the file.
    sd_position_m : (n, 3) array or None
        Standard deviations along the axes of `crs` [m].
    cov_position_m2 : (n, 3, 3) array or None
        Covariances along the axes of `crs` [m²], where the file has more than deviations.
    sd_attitude_deg : (n, 3) array or None
        Of roll, pitch, heading [deg].
    """

    time_s: FloatArray
    crs: str
    position: FloatArray
    attitude_deg: FloatArray | None
    sd_position_m: FloatArray | None = None
    cov_position_m2: FloatArray | None = None
    sd_attitude_deg: FloatArray | None = None


def check_times(path: Path, time_s: FloatArray, place: Callable[[int], str]) -> None:
    """Refuse fewer than two epochs, or times that do not ascend.

    `place` names the place of an epoch in the file, for the message.
    """
    if len(time_s) < 2:
        raise KgcpError(f"{path}: has {len(time_s)} epochs; interpolation needs at least two")
    wrong = np.flatnonzero(np.diff(time_s) <= 0.0)
    if wrong.size:
        row = int(wrong[0]) + 1
        how = "repeats" if time_s[row] == time_s[row - 1] else "lies before"
        raise KgcpError(
            f"{path}, {place(row)}: the time {how} that of {place(row - 1)}, by"
            f" {time_s[row - 1] - time_s[row]:g} s; sort the epochs and keep one of each"
        )
