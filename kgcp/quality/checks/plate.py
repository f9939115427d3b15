"""Whether a target's diameters can be in metres."""

from __future__ import annotations

from collections.abc import Sequence

from kgcp.quality.checks.doubt import Cause, Doubt, grave
from kgcp.targets.plain import AnyTarget

_LARGEST_M, _SMALLEST_M = 8.0, 0.02
_UNITS = (("inches", 0.0254), ("feet", 0.3048), ("centimetres", 0.01), ("millimetres", 0.001))
_USUAL_M = 0.15, 3.0


def check_plates(targets: Sequence[AnyTarget]) -> tuple[Doubt, ...]:
    """Tell diameters that are in other units than metres."""
    doubts = []
    for target in targets:
        diameter = target.outer_diameter_m
        if _SMALLEST_M < diameter < _LARGEST_M:
            continue
        low, high = _USUAL_M
        units = [
            f"{diameter * unit_m:.3g} m if these are {name}"
            for name, unit_m in _UNITS
            if low <= diameter * unit_m <= high
        ]
        hint = f" ({', '.join(units)})" if units else ""
        doubts.append(
            grave(
                Cause.DIAMETERS,
                f"target {target.name!r} has an outer diameter of {diameter:g} m{hint}",
                "give all diameters in metres",
                {"outer_diameter_m": diameter},
            )
        )
    return tuple(doubts)
