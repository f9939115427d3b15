"""Checks of standard deviations: those that are 0, or seem to be in another unit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kgcp.geometry.arrays import BoolArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.georef.trajectory import Motion
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.settings import VehicleSettings

_REMEDY = (
    "give those of the receiver's software, or remove their columns from the trajectory's file"
)
_MIN_SD_M, _MAX_SD_M = 0.0005, 10.0  # usual range of a receiver's positions
_MAX_LEVER_ARM_SD_M, _MAX_TIME_SD_S = 0.5, 0.5
_POSES_REMEDY = "give those of the adjustment, or remove their columns from the poses' file"


def check_deviations(motion: Motion) -> Iterator[Doubt]:
    """Yield doubts about standard deviations of a trajectory.

    These are epochs whose positions count as exact, attitudes that all do, and deviations that
    seem to be in millimetres or to be variances.
    """
    if motion.sd_position_m is not None:
        zero = np.any(motion.sd_position_m == 0.0, axis=1)
        if zero.any():
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                "standard deviations of the trajectory's positions are 0"
                f" at {_how_many(zero, 'epochs')}: points there are weighted far too much",
                _REMEDY,
                {"epochs": float(zero.sum())},
            )
        usual_m = np.median(motion.sd_position_m, axis=0)
        if 0.0 < usual_m.min() < _MIN_SD_M:
            yield _in_another_unit(
                float(usual_m.min()), "which suggests variances, or values in degrees"
            )
        elif usual_m.max() > _MAX_SD_M:
            yield _in_another_unit(float(usual_m.max()), "which suggests millimetres")
    if motion.sd_attitude_deg is not None and not motion.sd_attitude_deg.any():
        yield mild(
            Cause.STANDARD_DEVIATIONS,
            "standard deviations of the trajectory's attitudes are 0 at all epochs: the lever arm's"
            " direction counts as exact",
            _REMEDY,
        )


def check_vehicle_deviations(settings: VehicleSettings) -> Iterator[Doubt]:
    """Yield doubts about deviations of lever arm and time that seem to be in mm or ms."""
    for key, value, limit, unit in (
        ("sd_lever_arm_m", max(settings.sd_lever_arm_m), _MAX_LEVER_ARM_SD_M, "m"),
        ("sd_time_s", settings.sd_time_s, _MAX_TIME_SD_S, "s"),
    ):
        if value > limit:
            yield mild(
                Cause.STANDARD_DEVIATIONS,
                f"[vehicle] {key} is {value:g} {unit}, which makes all points very uncertain",
                f"give it in {unit}, not in m{unit}",
                {key: value},
            )


def _in_another_unit(sd_m: float, words: str) -> Doubt:
    return mild(
        Cause.STANDARD_DEVIATIONS,
        f"standard deviations of the trajectory's positions are {sd_m:.2g} m (median), {words}",
        "give standard deviations in metres",
        {"sd_m": sd_m},
    )


def check_pose_deviations(poses: ReferencePoses) -> Iterator[Doubt]:
    """Yield doubts about reference poses that count as exact."""
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
                f" in {_how_many(zero, 'poses')}: directions count as exact",
                _POSES_REMEDY,
                {"poses": float(zero.sum())},
            )


def _how_many(chosen: BoolArray, what: str) -> str:
    """Return how many of n are chosen, in words."""
    count = int(chosen.sum())
    return f"{count} of {len(chosen)} {what}" if count < len(chosen) else f"all {what}"
