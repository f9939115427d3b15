"""How far a vehicle may be from the interpolation of its trajectory, between the epochs.

Every inner epoch is compared with what its neighbours say of it: a spline through every second
epoch, and a turn about a fixed axis between the epochs before and after. Their steps are twice as
long. The error of an interpolation of order p grows with the p-th power of the step, so that of
the trajectory itself is 2ᵖ times smaller: 16 times for cubic splines, 4 times for turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.georef.trajectory import Motion, spread_samples

_SPLINE_ORDER, _TURN_ORDER = 4, 2
# At 1 Hz, steps of driven paths are too long for these orders; docs/method.md has what was found.
_MARGIN = 4.0 / 3.0
_NEARBY = np.arange(-1, 3)  # inner epochs about an interval, of which one may fit by chance
# Variance of what is compared, for epochs with independent errors of variance 1.
_SPLINE_NOISE, _TURN_NOISE = 1.7, 1.5
# Of a car, where only two epochs follow each other and nothing can be compared.
_ACCELERATION_M_S2, _ANGULAR_ACCELERATION_RAD_S2 = 1.0, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class InterpolationErrors:
    """Covariances of a trajectory's interpolation at n times, in the frame of its `Motion`."""

    cov_position_m2: FloatArray  # (n, 3, 3): of the trajectory point
    cov_turn_rad2: FloatArray  # (n, 3, 3): of a small rotation about the frame's axes


def interpolation_errors(motion: Motion, time_s: FloatArray) -> InterpolationErrors:
    """Estimate the errors at times (n,) that `Motion.coverage` reports to be inside.

    They vanish at the epochs. The noise of epochs, by their standard deviations, makes a part of
    what is compared; it is taken off, because these deviations count already.
    """
    errors = InterpolationErrors(np.zeros((len(time_s), 3, 3)), np.zeros((len(time_s), 3, 3)))
    left, fraction = motion.place(time_s)
    sd_turn_rad = None if motion.sd_attitude_deg is None else np.radians(motion.sd_attitude_deg)
    for run in motion.runs():
        chosen = (left >= run[0]) & (left < run[-1])
        if not chosen.any():
            continue
        knots = run[spread_samples(motion.time_s[run])]
        sampling = _Sampling.of(motion.time_s, knots, left[chosen], fraction[chosen])
        order = min(_SPLINE_ORDER, len(knots) // 2 + 1)  # of the shorter spline
        errors.cov_position_m2[chosen] = sampling.covariances(
            _spline_misfits(motion.time_s[knots], motion.position_m[knots]),
            _SPLINE_NOISE * _total_variance(motion.sd_position_m, knots),
            order,
            _ACCELERATION_M_S2,
        )
        errors.cov_turn_rad2[chosen] = sampling.covariances(
            _turn_misfits(
                motion.time_s[knots], motion.frame_from_body[knots], np.unique(sampling.nearby)
            ),
            _TURN_NOISE * _total_variance(sd_turn_rad, knots),
            _TURN_ORDER,
            _ANGULAR_ACCELERATION_RAD_S2,
        )
    return errors


def _total_variance(sd: FloatArray | None, knots: IndexArray) -> FloatArray:
    return np.zeros(len(knots)) if sd is None else np.asarray(np.sum(sd[knots] ** 2, axis=1))


def _spline_misfits(time_s: FloatArray, position_m: FloatArray) -> FloatArray:
    """Return by how much k samples miss a spline through every second one (k, 3); 0 at the ends."""
    from scipy.interpolate import CubicSpline  # 0.15 s that few commands need

    misfits = np.zeros_like(position_m)
    for start in (1, 2):
        is_left_out = np.zeros(len(time_s), dtype=bool)
        is_left_out[start:-1:2] = True
        if is_left_out.any():
            spline = CubicSpline(time_s[~is_left_out], position_m[~is_left_out])
            misfits[is_left_out] = position_m[is_left_out] - spline(time_s[is_left_out])
    return misfits


def _turn_misfits(
    time_s: FloatArray, frame_from_body: FloatArray, wanted: IndexArray
) -> FloatArray:
    """Return by how much k samples miss the turn between their neighbours (k, 3).

    Of those not wanted, and at the ends, it is 0.
    """
    misfits = np.zeros((len(time_s), 3))
    rows = wanted[(wanted > 0) & (wanted < len(time_s) - 1)]
    if rows.size:
        before, here, after = (
            Rotation.from_matrix(frame_from_body[rows + step]) for step in (-1, 0, 1)
        )
        share = (time_s[rows] - time_s[rows - 1]) / (time_s[rows + 1] - time_s[rows - 1])
        turn = (after * before.inv()).as_rotvec()
        between = Rotation.from_rotvec(share[:, None] * turn) * before
        misfits[rows] = (here * between.inv()).as_rotvec()
    return misfits


@dataclass(frozen=True, slots=True, eq=False)
class _Sampling:
    """Where n times lie among the k knots of a path."""

    step_s: FloatArray  # (n,): between the knots about them
    share: FloatArray  # (n,): of that step, which the epochs about them take
    bulge: FloatArray  # (n,): 1 in the middle between two epochs, 0 at both, a parabola between
    nearby: IndexArray  # (n, 4): knots near them
    is_inner: FloatArray  # (n, 4): 1 for those that can be compared, 0 at and beyond the ends
    # (k,): product of the steps before and after each knot [s²]; 1 at the ends
    steps_s2: FloatArray

    @classmethod
    def of(
        cls, time_s: FloatArray, knots: IndexArray, left: IndexArray, fraction: FloatArray
    ) -> _Sampling:
        """Find where times lie, by the epoch before each and the share of the way to the next."""
        last = len(knots) - 1
        steps = np.diff(time_s[knots])
        interval = np.clip(np.searchsorted(knots, left, side="right") - 1, 0, last - 1)
        step_s = steps[interval]
        share = (time_s[left + 1] - time_s[left]) / step_s
        bulge = 4.0 * fraction * (1.0 - fraction)
        nearby = interval[:, None] + _NEARBY
        is_inner = ((nearby > 0) & (nearby < last)).astype(np.float64)
        products = np.concatenate(([1.0], steps[:-1] * steps[1:], [1.0]))
        return cls(step_s, share, bulge, np.clip(nearby, 0, last), is_inner, products)

    def covariances(
        self, misfits: FloatArray, noise: FloatArray, order: int, acceleration: float
    ) -> FloatArray:
        """Return the covariances (n, 3, 3) that the misfits (k, 3) nearby let expect.

        Parameters
        ----------
        noise : (k,) array
            Sum of the variances that the epochs' noise gives to the three misfits.
        order : int
            With which power of the step the misfits grow.
        acceleration : float
            Standard deviation of that along each axis, where no misfit is known.
        """
        unseen = np.eye(3) * (acceleration * self.step_s**2 / 8.0)[:, None, None] ** 2
        # with the square of the step, to the square of what the other path had at its epoch
        weight = (
            self.is_inner
            * (self.step_s[:, None] ** 2 / (4.0 * self.steps_s2[self.nearby])) ** order
        )
        count = np.maximum(self.is_inner.sum(axis=1), 1.0)
        beside = misfits[self.nearby]
        mean = np.einsum("nk,nki,nkj->nij", weight, beside, beside) / count[:, None, None]
        total = np.trace(mean, axis1=1, axis2=2)
        excess = total - np.sum(weight * noise[self.nearby], axis=1) / count
        real = np.divide(excess, total, out=np.zeros_like(total), where=total > 0.0)
        seen = _MARGIN**2 * np.maximum(real, 0.0)[:, None, None] * mean
        # a smooth path leaves its spline near a knot more slowly, one of coarse steps like this;
        # epochs that are no knots bring the path nearer, by the square of the step between them
        shape = (self.bulge * self.share**2) ** 2
        is_seen = np.any(self.is_inner > 0.0, axis=1, keepdims=True)
        return np.asarray(np.where(is_seen[:, :, None], seen, unseen) * shape[:, None, None])
