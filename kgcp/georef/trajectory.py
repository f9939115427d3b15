"""The vehicle's trajectory, and its state between the samples.

Body axes are x forward, y right, z down; roll, pitch and heading turn them from north, east, down
in the order Z-Y-X (docs/conventions.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.georef.local_frame import LocalFrame, level_axes_ecef

ENU_FROM_NED: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

# An interval is a gap if it is longer than both: this time, and this many medians of the interval.
_MIN_GAP_S = 0.5
_GAP_INTERVALS = 1.5
# Largest ratio of neighbouring steps of a spline. Beyond it, noise over the shorter step bends the
# spline in the longer one.
_MAX_STEP_RATIO = 2.5
_HALF_BASE_S = 0.25  # of a course: over one interval of a fast logger it would be mere noise
_MIN_SPEED_M_S = 0.5  # below, the course is dominated by the noise of positions


def body_to_ned(roll_deg: FloatArray, pitch_deg: FloatArray, heading_deg: FloatArray) -> FloatArray:
    """Return the rotations (..., 3, 3) from body axes to north, east, down.

    R = Rz(heading) Ry(pitch) Rx(roll); angles in degrees, arrays of shape (...).
    """
    angles = np.stack(np.broadcast_arrays(heading_deg, pitch_deg, roll_deg), axis=-1)
    flat = Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True).as_matrix()
    return np.asarray(flat.reshape((*angles.shape[:-1], 3, 3)))


def roll_pitch_heading_deg(body_in_ned: FloatArray) -> FloatArray:
    """Return roll, pitch, heading (n, 3) [deg] of rotations (n, 3, 3); undoes `body_to_ned`."""
    angles = Rotation.from_matrix(body_in_ned).as_euler("ZYX", degrees=True)
    return np.asarray(angles[:, ::-1])


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A vehicle's trajectory as given by its file: map positions, heading from true north."""

    time_s: FloatArray  # (n,): Unix time, UTC, strictly ascending, n ≥ 2 [s]
    position_map: FloatArray  # (n, 3): x, y, z in the flight's CRS
    # (n, 3): roll, pitch and heading relative to the local horizontal and true north [deg]
    attitude_deg: FloatArray
    # (n, 3): standard deviations along the map's axes [m]; None: the file has none
    sd_position_m: FloatArray | None
    # (n, 3): of roll, pitch, heading [deg]; None: the file has none
    sd_attitude_deg: FloatArray | None
    # (n, 3, 3): covariances along the map's axes [m²], whose diagonals are the squares of
    # `sd_position_m`; None: the file has standard deviations at most
    cov_position_m2: FloatArray | None = None
    format: str = ""  # of its file, as [vehicle] format names it; "": it is from no file


class Coverage(StrEnum):
    """Whether a trajectory can be interpolated at a time."""

    INSIDE = "inside"
    BEFORE = "before_trajectory"
    AFTER = "after_trajectory"
    GAP = "in_trajectory_gap"


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """The vehicle at n times, in the Cartesian frame of its `Motion`."""

    # (n, 3): of the trajectory point [m, m/s]
    position_m: FloatArray
    velocity_m_s: FloatArray
    frame_from_body: FloatArray  # (n, 3, 3): attitude
    angular_velocity_rad_s: FloatArray  # (n, 3): in the frame's axes [rad/s]
    # as in `Trajectory`
    sd_position_m: FloatArray | None
    sd_attitude_deg: FloatArray | None
    cov_position_m2: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A trajectory in a Cartesian frame, ready to be interpolated."""

    time_s: FloatArray  # (n,): Unix time, UTC, strictly ascending, n ≥ 2 [s]
    position_m: FloatArray  # (n, 3): in the frame [m]
    frame_from_body: FloatArray  # (n, 3, 3): body axes in the frame, as columns
    # as in `Trajectory`
    sd_position_m: FloatArray | None
    sd_attitude_deg: FloatArray | None
    cov_position_m2: FloatArray | None = None

    @property
    def max_gap_s(self) -> float:
        """Longest interval that is interpolated [s]: 0.5 s, or 1.5 usual intervals if longer.

        Over half a second, the path of a car deviates from a cubic by a few millimetres only.
        """
        return max(_MIN_GAP_S, _GAP_INTERVALS * float(np.median(np.diff(self.time_s))))

    def coverage(self, time_s: FloatArray) -> list[Coverage]:
        """Return for each time (m,) whether it can be interpolated, and if not, why."""
        left = self._left(time_s)
        in_gap = (np.diff(self.time_s) > self.max_gap_s)[left] & ~np.isin(time_s, self.time_s)
        choices = np.select(
            [time_s < self.time_s[0], time_s > self.time_s[-1], in_gap],
            [Coverage.BEFORE, Coverage.AFTER, Coverage.GAP],
            Coverage.INSIDE,
        )
        return [Coverage(str(choice)) for choice in choices]

    def states(self, time_s: FloatArray) -> States:
        """Interpolate at times (m,) that `coverage` reports to be inside.

        Positions follow a cubic spline, separately between gaps. A straight chord would not do: a
        turning car leaves it by v²/R·h²/8, which is 6 mm at 10 Hz and 0.6 m at 1 Hz (10 m/s,
        R = 20 m). The spline deviates from that circle by 0.01 mm at 10 Hz and by 4 mm at 1 Hz, but
        by 35 mm in the first and last interval. Samples that follow others closely are not knots of
        the spline, because noise over a short interval would become waves over a long one. Their
        offsets from the spline are interpolated linearly and added, so that the path goes through
        all samples. Attitudes turn about a fixed axis between two samples (slerp). Standard
        deviations are those of the samples; `interpolation_errors` returns what interpolation adds.
        """
        left, fraction = self.place(time_s)
        position, velocity = self._positions(time_s, left, fraction)
        attitude, rate = self._attitudes(left, fraction)
        return States(
            position,
            velocity,
            attitude,
            rate,
            _between(self.sd_position_m, left, fraction),
            _between(self.sd_attitude_deg, left, fraction),
            _between(self.cov_position_m2, left, fraction),
        )

    def place(self, time_s: FloatArray) -> tuple[IndexArray, FloatArray]:
        """Return the sample before each time (m,), and the share of the way to the next, 0 … 1."""
        left = self._left(time_s)
        return left, (time_s - self.time_s[left]) / np.diff(self.time_s)[left]

    def runs(self) -> list[IndexArray]:
        """Return the indices of the samples between gaps."""
        breaks = np.flatnonzero(np.diff(self.time_s) > self.max_gap_s) + 1
        return np.split(np.arange(len(self.time_s)), breaks)

    def _left(self, time_s: FloatArray) -> IndexArray:
        """Return the index of the sample at the start of each time's interval.

        A time exactly at the sample before a gap belongs to the interval before it, because the
        motion across the gap is unknown.
        """
        after = np.searchsorted(self.time_s, time_s, side="right")
        left = np.clip(after - 1, 0, len(self.time_s) - 2)
        is_gap = np.diff(self.time_s) > self.max_gap_s
        ends = (time_s == self.time_s[left]) & is_gap[left] & ~is_gap[left - 1] & (left > 0)
        return np.asarray(left - ends)

    def _positions(
        self, time_s: FloatArray, left: IndexArray, fraction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        from scipy.interpolate import CubicSpline  # 0.15 s that few commands need

        intervals = np.diff(self.time_s)
        velocity = (np.diff(self.position_m, axis=0) / intervals[:, None])[left]
        position = self.position_m[left] + velocity * (time_s - self.time_s[left])[:, None]
        for run in self.runs():
            chosen = (left >= run[0]) & (left < run[-1])
            if not chosen.any():
                continue
            since, samples = self.time_s[run] - self.time_s[run[0]], self.position_m[run]
            knots = spline_knots(since)
            spline = CubicSpline(since[knots], samples[knots])
            offsets = samples - spline(since)  # 0 at the knots
            wanted = time_s[chosen] - self.time_s[run[0]]
            offset = _interpolated(offsets, left[chosen] - run[0], fraction[chosen])
            position[chosen], velocity[chosen] = spline(wanted) + offset, spline(wanted, 1)
        return position, velocity

    def _attitudes(self, left: IndexArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        samples = Rotation.from_matrix(self.frame_from_body)
        start, end = samples[left], samples[left + 1]
        turn = (end * start.inv()).as_rotvec()
        attitude = Rotation.from_rotvec(fraction[:, None] * turn) * start
        return attitude.as_matrix(), turn / np.diff(self.time_s)[left, None]


def spline_knots(time_s: FloatArray) -> IndexArray:
    """Return which of n ≥ 2 samples are knots of a spline: the ends, and no two too close.

    The step next to a long one may be shorter by a factor of `_MAX_STEP_RATIO`. Farther from it,
    steps may be shorter still, in proportion to the time.
    """
    steps = np.diff(time_s)
    # (n - 1,): largest length of a step minus the time from it, at the samples after and before
    # the steps
    after = np.maximum.accumulate(steps + time_s[1:]) - time_s[1:]
    before = np.maximum.accumulate((steps - time_s[:-1])[::-1])[::-1] + time_s[:-1]
    # (n - 2,): least step before the inner samples
    least = np.maximum(after[:-1], before[1:]) / _MAX_STEP_RATIO
    is_knot = np.ones(len(time_s), dtype=bool)
    last = 0
    for sample in (np.flatnonzero(steps[:-1] < least) + 1).tolist():
        last = sample - 1 if is_knot[sample - 1] else last
        is_knot[sample] = time_s[sample] - time_s[last] >= least[sample - 1]
    last = int(np.flatnonzero(is_knot[:-1])[-1])  # no knot if it is too close to the end of the run
    is_knot[last] = last == 0 or time_s[-1] - time_s[last] >= after[-1] / _MAX_STEP_RATIO
    return np.flatnonzero(is_knot)


def _between(
    samples: FloatArray | None, left: IndexArray, fraction: FloatArray
) -> FloatArray | None:
    return None if samples is None else _interpolated(samples, left, fraction)


def _interpolated(samples: FloatArray, left: IndexArray, fraction: FloatArray) -> FloatArray:
    step = samples[left + 1] - samples[left]
    share = fraction.reshape(-1, *(1 for _ in samples.shape[1:]))
    return np.asarray(samples[left] + share * step)


def attitude_from_course(
    file: str, time_s: FloatArray, position: FloatArray, crs: str
) -> FloatArray:
    """Return roll = pitch = 0 and the course over ground as heading (n, 3) [deg].

    The course is the direction of a chord, which in a steady curve is that of the tangent. The
    chord extends from 0.25 s before an epoch to 0.25 s after it, or over one usual interval on
    either side if that is longer. A standing vehicle keeps its last course; before it first moves,
    it has that of its first movement.

    Raises
    ------
    KgcpError
        If the vehicle never moves.
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
