"""Standard deviations that nobody has measured: those that are 0."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild

_REMEDY = (
    "give those of the receiver's software, or leave their columns out of the trajectory's file"
)


def check_deviations(motion: Motion) -> Iterator[Doubt]:
    """Tell epochs whose positions, and trajectories whose attitudes, count as free of error."""
    if motion.sd_position_m is not None:
        zero = np.any(motion.sd_position_m == 0.0, axis=1)
        count, epochs = int(zero.sum()), len(zero)
        which = f"at {count} of {epochs} epochs" if count < epochs else "at all epochs"
        if count:
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                f"standard deviations of the trajectory's positions are 0 {which}: points there"
                " count as far too accurate",
                _REMEDY,
                {"epochs": float(count)},
            )
    if motion.sd_attitude_deg is not None and not motion.sd_attitude_deg.any():
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            "standard deviations of the trajectory's attitudes are 0 at all epochs: the lever arm's"
            " direction counts as free of error",
            _REMEDY,
        )
