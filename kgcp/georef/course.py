"""The attitude of a vehicle that goes where it points."""

from __future__ import annotations

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import LocalFrame, level_axes_ecef

_HALF_BASE_S = 0.25  # one step of a fast logger is all noise
_MIN_SPEED_M_S = 0.5  # slower, the noise of positions turns the course


def attitude_from_course(
    file: str, time_s: FloatArray, position: FloatArray, crs: str
) -> FloatArray:
    """Return roll = pitch = 0 and the course over ground as heading (n, 3) [deg].

    The course is that of the chord from 0.25 s (or one usual interval, if that is longer) before
    an epoch to as much after it, which is the tangent of a steady curve. While the vehicle
    stands it keeps its last course; before it first moves it has that of its first move.

    Raises
    ------
    KgcpError
        If it never moves.
    """
    local_frame = LocalFrame.at(crs, position[0])
    enu = local_frame.enu_from_map(position)
    half_s = max(_HALF_BASE_S, float(np.median(np.diff(time_s))))
    since = time_s - time_s[0]
    start, end = (np.clip(since + step, 0.0, since[-1]) for step in (-half_s, half_s))
    chord = np.column_stack(
        [np.interp(end, since, axis) - np.interp(start, since, axis) for axis in enu.T]
    )
    level = level_axes_ecef(crs, position)
    east, north, _ = np.einsum("nji,nj->in", level, chord @ local_frame.ecef_from_enu.T)
    moves = np.hypot(east, north) > _MIN_SPEED_M_S * (end - start)
    if not moves.any():
        raise KgcpError(
            f"{file}: the vehicle never moves, so its course gives no heading;"
            " give a trajectory with attitude"
        )
    last_move = np.maximum.accumulate(np.where(moves, np.arange(len(moves)), -1))
    chosen = np.where(last_move < 0, int(np.argmax(moves)), last_move)
    heading = np.degrees(np.arctan2(east, north))[chosen] % 360.0
    return np.column_stack((np.zeros((len(heading), 2)), heading))
