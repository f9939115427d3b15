"""Single epochs of a trajectory that jump away from the others and back."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild

_SMALLEST_M = 1.5  # coordinates of five decimals in degrees have steps of 1.1 m
_MAX_ACCELERATION_M_S2 = 10.0
_FAR_SDS = 8.0  # of the three coordinates together
_FAR = 6.0  # times the usual deviation, where standard deviations are too small or not stated
_SMOOTH_SHARE = 0.25  # of the jump, which the path may bend by without its epoch


def check_spikes(motion: Motion) -> Iterator[Doubt]:
    """Tell single epochs that lie far from the line between the one before and the one after.

    A vehicle that brakes or turns leaves that line, too, but without that epoch the others form no
    smooth path then. The first and the last epoch are not examined.
    """
    epochs = np.arange(len(motion.time_s))
    middle = epochs[1:-1]
    if not len(middle):
        return
    off_m = _off_chord_m(motion, middle - 1, middle, middle + 1)
    before_s, after_s = np.diff(motion.time_s)[:-1], np.diff(motion.time_s)[1:]
    allowed_m = 0.5 * _MAX_ACCELERATION_M_S2 * before_s * after_s
    if motion.sd_position_m is not None:
        sd_m = np.linalg.norm(motion.sd_position_m, axis=1)
        allowed_m += _FAR_SDS * np.max([sd_m[:-2], sd_m[1:-1], sd_m[2:]], axis=0)
    allowed_m = np.maximum(allowed_m, max(_SMALLEST_M, _FAR * float(np.median(off_m))))
    chosen = off_m > allowed_m
    spikes, off_m = middle[chosen], off_m[chosen]
    left, right = np.maximum(spikes - 2, 0), np.minimum(spikes + 2, epochs[-1])
    bend_m = np.maximum(
        _off_chord_m(motion, left, spikes - 1, spikes + 1),
        _off_chord_m(motion, spikes - 1, spikes + 1, right),
    )
    is_spike = bend_m < _SMOOTH_SHARE * off_m
    spikes, off_m = spikes[is_spike], off_m[is_spike]
    if not len(spikes):
        return
    worst = int(np.argmax(off_m))
    when = datetime.fromtimestamp(float(motion.time_s[spikes[worst]]), UTC)
    count = len(spikes) - 1
    others = f", as {count} other{' does' if count == 1 else 's do'} by less" if count else ""
    yield mild(
        Cause.TRAJECTORY_SPIKE,
        f"the epoch of {when:%Y-%m-%d %H:%M:%S.%f} UTC lies {off_m[worst]:.1f} m from those before"
        f" and after it{others}: more than the trajectory's standard deviations and a vehicle's"
        " acceleration allow",
        "delete the epoch from the trajectory's file if it is wrong: it displaces points near it",
        {"jump_m": float(off_m[worst]), "epochs": float(len(spikes))},
    )


def _off_chord_m(
    motion: Motion, start: IndexArray, epoch: IndexArray, end: IndexArray
) -> FloatArray:
    """Return how far epochs (n,) lie from the motion between two others [m]; 0 at these."""
    time_s, position_m = motion.time_s, motion.position_m
    share = (time_s[epoch] - time_s[start]) / (time_s[end] - time_s[start])
    chord = position_m[end] - position_m[start]
    return np.asarray(
        np.linalg.norm(position_m[epoch] - position_m[start] - share[:, None] * chord, axis=1)
    )
