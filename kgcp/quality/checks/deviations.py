"""Standard deviations that nobody has measured: those that are 0."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kgcp.geometry.arrays import BoolArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild

_REMEDY = (
    "give those of the receiver's software, or leave their columns out of the trajectory's file"
)
_POSES_REMEDY = "give those of the adjustment, or leave their columns out of the poses' file"


def check_deviations(motion: Motion) -> Iterator[Doubt]:
    """Tell epochs whose positions, and trajectories whose attitudes, count as free of error."""
    if motion.sd_position_m is not None:
        zero = np.any(motion.sd_position_m == 0.0, axis=1)
        if zero.any():
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                "standard deviations of the trajectory's positions are 0"
                f" at {_how_many(zero, 'epochs')}: points there count as far too accurate",
                _REMEDY,
                {"epochs": float(zero.sum())},
            )
    if motion.sd_attitude_deg is not None and not motion.sd_attitude_deg.any():
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            "standard deviations of the trajectory's attitudes are 0 at all epochs: the lever arm's"
            " direction counts as free of error",
            _REMEDY,
        )


def check_pose_deviations(poses: ReferencePoses) -> Iterator[Doubt]:
    """Tell reference poses that count as free of error."""
    if poses.sd_position_m is not None:
        zero = np.any(poses.sd_position_m == 0.0, axis=1)
        if zero.any():
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                "standard deviations of the reference poses' positions are 0"
                f" in {_how_many(zero, 'poses')}: reference distances count as far too accurate",
                _POSES_REMEDY,
                {"poses": float(zero.sum())},
            )
    if poses.sd_angle_deg is not None:
        zero = poses.sd_angle_deg == 0.0
        if zero.any():
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                "standard deviations of the reference poses' angles are 0"
                f" in {_how_many(zero, 'poses')}: directions count as free of error",
                _POSES_REMEDY,
                {"poses": float(zero.sum())},
            )


def _how_many(chosen: BoolArray, what: str) -> str:
    """Return which of n are chosen, in words."""
    count = int(chosen.sum())
    return f"{count} of {len(chosen)} {what}" if count < len(chosen) else f"all {what}"
