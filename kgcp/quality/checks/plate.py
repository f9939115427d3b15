"""Whether a target's diameters can be in metres, and whether the search finds its layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import AnyTarget

_LARGEST_M, _SMALLEST_M = 8.0, 0.02
_UNITS = (("inches", 0.0254), ("feet", 0.3048), ("centimetres", 0.01))
_USUAL_M = 0.15, 3.0
# Of simulated targets within these, the search finds 97 %; of rings with a ratio of 0.35 it finds
# 55 %, with 0.3 32 % and with 0.75 69 % (`python -m benchmarks.search.layouts`).
_INNER_RATIO = 0.4, 0.7
_MOST_WHITE = 0.33  # of the ring's area, in dots


def check_plates(targets: Sequence[AnyTarget]) -> Iterator[Doubt]:
    """Tell diameters that are in other units than metres, and layouts that are hard to find."""
    for target in targets:
        if isinstance(target, Target):
            yield from _check_layout(target.ring)
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
        yield grave(
            Cause.DIAMETERS,
            f"target {target.name!r} has an outer diameter of {diameter:g} m{hint}",
            "give all diameters in metres",
            {"outer_diameter_m": diameter},
        )


def _check_layout(ring: Ring) -> Iterator[Doubt]:
    ratio = ring.inner_ratio
    ring_m2 = ring.outer_diameter_m**2 - ring.inner_diameter_m**2
    white = len(ring.code_deg) * ring.dot_diameter_m**2 / ring_m2
    low, high = _INNER_RATIO
    figures = {"inner_ratio": ratio, "white_share": white}
    remedy = "print targets as 'kgcp target' draws them, with an inner diameter of half the outer"
    if not low <= round(ratio, 6) <= high:
        problem = (
            f"the inner diameter of {ring.name!r} is {ratio:.2f} of the outer one, and many rings"
            f" beyond {low:g} to {high:g} are not found"
        )
    elif white > _MOST_WHITE:
        problem = f"the dots of {ring.name!r} take {white:.0%} of the ring, and many are not found"
    else:
        return
    yield mild(Cause.LAYOUT, problem, remedy, figures)
