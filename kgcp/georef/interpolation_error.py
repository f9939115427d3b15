"""Errors of a trajectory's interpolation between its epochs.

Every inner epoch is compared with an interpolation without it. For positions this is a spline
through every second epoch; for attitudes, a turn about a fixed axis from the epoch before to the
one after. The misfits are errors of an interpolation with twice the step. The error of an
interpolation of order p grows with the p-th power of the step. The error of the trajectory's own
interpolation is therefore 2ᵖ times smaller: 16 times for cubic splines, 4 times for turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.georef.trajectory import Motion, spline_knots

_SPLINE_ORDER, _TURN_ORDER = 4, 2
# Factor on the estimated errors. In simulated drives at 1 Hz the steps are too long for the powers
# above: errors of attitudes are 1/4 to 1/3 of the misfits instead of 1/4, those of positions 1/30
# to 1/6 instead of 1/16 (docs/method/points.md, "Points").
_MARGIN = 4.0 / 3.0
# Epochs around an interval, counted from the one before it. The misfits of four are averaged,
# because a single one may be small by chance.
_NEARBY = np.arange(-1, 3)
# Variance of a misfit if the epochs have independent errors of variance 1.
_SPLINE_NOISE, _TURN_NOISE = 1.7, 1.5
# Standard deviations of a car's accelerations. They replace the misfits where no epoch can be left
# out, because a run between two gaps has two epochs only.
_ACCELERATION_M_S2, _ANGULAR_ACCELERATION_RAD_S2 = 1.0, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class InterpolationErrors:
    """Covariances of a trajectory's interpolation at n times, in the frame of its `Motion`."""

    cov_position_m2: FloatArray  # (n, 3, 3): of the trajectory point
    cov_turn_rad2: FloatArray  # (n, 3, 3): of a small rotation about the frame's axes


def interpolation_errors(motion: Motion, time_s: FloatArray) -> InterpolationErrors:
    """Estimate the errors at times (n,) that `Motion.coverage` reports to be inside.

    They vanish at the epochs. The epochs' own noise contributes to the misfits. Its share, by the
    stated standard deviations, is subtracted, because it is already part of the states' covariance.
    """
    errors = InterpolationErrors(np.zeros((len(time_s), 3, 3)), np.zeros((len(time_s), 3, 3)))
    left, fraction = motion.place(time_s)
    sd_turn_rad = None if motion.sd_attitude_deg is None else np.radians(motion.sd_attitude_deg)
    for run in motion.runs():
        chosen = (left >= run[0]) & (left < run[-1])
        if not chosen.any():
            continue
        knots = run[spline_knots(motion.time_s[run])]
        sampling = _Sampling.of(motion.time_s, knots, left[chosen], fraction[chosen])
        # the spline through every second knot has a lower order if it has few knots
        order = min(_SPLINE_ORDER, len(knots) // 2 + 1)
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
    """Return the offsets (k, 3) of k samples from a spline through every second; 0 at the ends."""
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
    """Return the rotations (k, 3) of k samples from the turn between their neighbours [rad].

    They are 0 for the samples that are not wanted, and at the ends.
    """
    misfits = np.zeros((len(time_s), 3))
    rows = wanted[(wanted > 0) & (wanted < len(time_s) - 1)]
    if rows.size:
        before, here, after = (
            Rotation.from_matrix(frame_from_body[rows + step]) for step in (-1, 0, 1)
        )
        share = (time_s[rows] - time_s[rows - 1]) / (time_s[rows + 1] - time_s[rows - 1])
        turn = (after * before.inv()).as_rotvec()
        interpolated = Rotation.from_rotvec(share[:, None] * turn) * before
        misfits[rows] = (here * interpolated.inv()).as_rotvec()
    return misfits


@dataclass(frozen=True, slots=True, eq=False)
class _Sampling:
    """How n times lie among the k knots of a path, which are epochs, but need not be all."""

    step_s: FloatArray  # (n,): interval between the knots on either side
    share: FloatArray  # (n,): interval between the epochs on either side, over `step_s`
    bulge: FloatArray  # (n,): parabola between these epochs: 0 at both, 1 in the middle
    nearby: IndexArray  # (n, 4): nearby knots, by number
    is_inner: FloatArray  # (n, 4): 1 for nearby knots that have a misfit, 0 at and beyond the ends
    # (k,): product of the steps before and after each knot [s²]; 1 at the ends
    steps_s2: FloatArray

    @classmethod
    def of(
        cls, time_s: FloatArray, knots: IndexArray, left: IndexArray, fraction: FloatArray
    ) -> _Sampling:
        """Find how times lie, given the epoch before each and the share of the way to the next."""
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
        """Return the covariances (n, 3, 3) to be expected from the misfits (k, 3) nearby.

        Parameters
        ----------
        noise : (k,) array
            Share of the epochs' noise in the sum of the three misfits' variances.
        order : int
            Power of the step with which the misfits grow.
        acceleration : float
            Its standard deviation along each axis; used where there is no misfit.
        """
        without_misfits = np.eye(3) * (acceleration * self.step_s**2 / 8.0)[:, None, None] ** 2
        # square of (step / misfit's step)ᵖ, the latter twice the geometric mean of its two steps
        weight = (
            self.is_inner
            * (self.step_s[:, None] ** 2 / (4.0 * self.steps_s2[self.nearby])) ** order
        )
        count = np.maximum(self.is_inner.sum(axis=1), 1.0)
        around = misfits[self.nearby]
        mean = np.einsum("nk,nki,nkj->nij", weight, around, around) / count[:, None, None]
        total = np.trace(mean, axis1=1, axis2=2)
        excess = total - np.sum(weight * noise[self.nearby], axis=1) / count
        beyond_noise = np.divide(excess, total, out=np.zeros_like(total), where=total > 0.0)
        by_misfits = _MARGIN**2 * np.maximum(beyond_noise, 0.0)[:, None, None] * mean
        # With coarse steps the error grows from an epoch like this parabola, on a smooth path more
        # slowly. Epochs that are not knots reduce it with the square of the interval between them.
        shape = (self.bulge * self.share**2) ** 2
        has_misfits = np.any(self.is_inner > 0.0, axis=1, keepdims=True)
        return np.asarray(
            np.where(has_misfits[:, :, None], by_misfits, without_misfits) * shape[:, None, None]
        )
