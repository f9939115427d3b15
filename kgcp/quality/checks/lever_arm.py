"""Check of the lever arm from a vehicle's trajectory point to a plate on its roof."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.settings import VehicleSettings

_MAX_DOWN_M = 1.0  # of a plate below the trajectory point, an antenna on a mast
_MAX_LENGTH_M = 10.0


def check_lever_arm(settings: VehicleSettings, on_vehicle: Sequence[str]) -> Iterator[Doubt]:
    """Yield doubts about targets far below the trajectory point, beyond the vehicle, or together.

    Parameters
    ----------
    on_vehicle : sequence of str
        Names of the targets that do not stand still.
    """
    if len(on_vehicle) > 1:
        yield mild(
            Cause.LEVER_ARM,
            f"targets {' and '.join(on_vehicle)} share one lever arm: export-gcp refuses them if"
            " more than one is measured",
            "give position_m to those that stand still, and leave out those that are not on this"
            " vehicle",
            {"targets": float(len(on_vehicle))},
        )
    forward, right, down = settings.lever_arm_m
    figures = {"forward_m": forward, "right_m": right, "down_m": down}
    if math.hypot(forward, right, down) > _MAX_LENGTH_M:
        yield mild(
            Cause.LEVER_ARM,
            f"the lever arm is {math.hypot(forward, right, down):.1f} m long",
            "give it in metres, as forward, right, down",
            figures,
        )
    elif down > _MAX_DOWN_M:
        yield mild(
            Cause.LEVER_ARM,
            f"the lever arm puts the target {down:.2f} m below the trajectory point",
            f"if the plate is above it, give lever_arm_m[2] = {-down:g}: the third number is"
            " positive downwards",
            figures,
        )


def lever_arm_text(settings: VehicleSettings) -> str:
    """Return the direction from the trajectory point to the target, in words."""
    forward, right, down = settings.lever_arm_m
    parts = (
        (forward, "in front", "behind"),
        (right, "to the right", "to the left"),
        (-down, "above", "below"),
    )
    words = [
        f"{abs(value):.2f} m {positive if value > 0.0 else negative}"
        for value, positive, negative in parts
        if abs(value) >= 0.005
    ]
    return ", ".join(words) or "the point itself"
