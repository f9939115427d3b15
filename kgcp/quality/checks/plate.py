"""Checks of a target's diameters and layout: metres, and proportions that the search finds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import AnyTarget

_MAX_DIAMETER_M, _MIN_DIAMETER_M = 8.0, 0.02
_UNITS = (("inches", 0.0254), ("feet", 0.3048), ("centimetres", 0.01))
_USUAL_DIAMETERS_M = 0.15, 3.0
# Range of the inner over the outer diameter. The search finds 97 % of simulated targets within this
# range and with fewer or smaller dots than the limit below. It finds 32 % with a ratio of 0.3,
# 55 % with 0.35 and 69 % with 0.75 (`python -m benchmarks.search.layouts`).
_INNER_RATIOS = 0.4, 0.7
_MAX_DOT_SHARE = 0.33  # of the ring's area


def check_plates(targets: Sequence[AnyTarget]) -> Iterator[Doubt]:
    """Yield doubts about diameters in other units, and about layouts that are hard to find."""
    for target in targets:
        if isinstance(target, Target):
            yield from _check_layout(target.ring)
        diameter = target.outer_diameter_m
        if _MIN_DIAMETER_M < diameter < _MAX_DIAMETER_M:
            continue
        low, high = _USUAL_DIAMETERS_M
        units = [
            f"{diameter * unit_m:.3g} m if it is in {name}"
            for name, unit_m in _UNITS
            if low <= diameter * unit_m <= high
        ]
        hint = f" ({', '.join(units)})" if units else ""
        yield grave(
            Cause.DIAMETERS,
            f"target {target.name!r} has an outer diameter of {diameter:g} m{hint}",
            "give all diameters in metres",
            {"outer_diameter_m": diameter},
        )


def _check_layout(ring: Ring) -> Iterator[Doubt]:
    ratio = ring.inner_ratio
    ring_m2 = ring.outer_diameter_m**2 - ring.inner_diameter_m**2
    dot_share = len(ring.code_deg) * ring.dot_diameter_m**2 / ring_m2
    low, high = _INNER_RATIOS
    figures = {"inner_ratio": ratio, "white_share": dot_share}
    remedy = "print targets as 'kgcp target' draws them, with an inner diameter of half the outer"
    if not low <= round(ratio, 6) <= high:
        problem = (
            f"the inner diameter of {ring.name!r} is {ratio:.2f} times the outer one; outside"
            f" {low:g} to {high:g}, many rings are not found"
        )
    elif dot_share > _MAX_DOT_SHARE:
        problem = (
            f"the dots of {ring.name!r} cover {dot_share:.0%} of the ring; many such rings are not"
            " found"
        )
    else:
        return
    yield mild(Cause.LAYOUT, problem, remedy, figures)
