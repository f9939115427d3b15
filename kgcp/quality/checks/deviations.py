"""Standard deviations that nobody has measured: those that are 0, or of another unit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kgcp.geometry.arrays import BoolArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.settings import VehicleSettings

_REMEDY = (
    "give those of the receiver's software, or leave their columns out of the trajectory's file"
)
_LEAST_M, _MOST_M = 0.0005, 10.0  # of a receiver's positions, usually
_MOST_ARM_M, _MOST_TIME_S = 0.5, 0.5
_POSES_REMEDY = "give those of the adjustment, or leave their columns out of the poses' file"


def check_deviations(motion: Motion) -> Iterator[Doubt]:
    """Tell epochs whose positions, and trajectories whose attitudes, count as free of error.

    Deviations of millimetres that are read as metres, and variances, are told as well.
    """
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
        usual_m = np.median(motion.sd_position_m, axis=0)
        if 0.0 < usual_m.min() < _LEAST_M:
            yield _of_another_unit(float(usual_m.min()), "as variances or degrees would be")
        elif usual_m.max() > _MOST_M:
            yield _of_another_unit(float(usual_m.max()), "as millimetres would be")
    if motion.sd_attitude_deg is not None and not motion.sd_attitude_deg.any():
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            "standard deviations of the trajectory's attitudes are 0 at all epochs: the lever arm's"
            " direction counts as free of error",
            _REMEDY,
        )


def check_vehicle_deviations(settings: VehicleSettings) -> Iterator[Doubt]:
    """Tell deviations of lever arm and synchronisation that seem to be in thousandths."""
    for key, value, most, unit in (
        ("sd_lever_arm_m", max(settings.sd_lever_arm_m), _MOST_ARM_M, "m"),
        ("sd_time_s", settings.sd_time_s, _MOST_TIME_S, "s"),
    ):
        if value > most:
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                f"[vehicle] {key} is {value:g} {unit}, which makes all points as uncertain",
                f"give it in {unit}, not in m{unit}",
                {key: value},
            )


def _of_another_unit(sd_m: float, words: str) -> Doubt:
    return mild(
        Cause.STANDARD_DEVIATIONS,
        f"standard deviations of the trajectory's positions are {sd_m:.2g} m (median), {words}",
        "give standard deviations in metres",
        {"sd_m": sd_m},
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
