"""Checks of a target's diameters and layout: metres, proportions that the search finds, the print.

A print that is not as stated leaves residuals that are the same in all frames. One frame only has
larger standard deviations, as if its image were poor; all frames together show the cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import amount
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
# Least angle that a dot subtends at the centre; the search samples rings every 3°. Of targets with
# inner ratios of 0.4 to 0.7 and dots above it, the same benchmark finds 95 %; of those below, 64 %.
_MIN_DOT_DEG = 8.0
_MIN_FRAMES = 6
# A print is in doubt if its inner circle or its code is larger or smaller than stated by this share
# and by so many standard deviations. A share of 0.2 % makes distances wrong by 0.03 to 0.08 %.
_MIN_GROWTH, _MIN_RATIO = 2e-3, 5.0
# What may displace the inner edge in all frames alike, as an error of the tone curve does [px]
_SD_EDGE_PX = 0.03
_ROBUST_STEPS = 10
_MEDIAN_CHI2 = 0.455  # of one degree of freedom


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
    dot_deg = 2.0 * ring.dot_half_angle_deg
    low, high = _INNER_RATIOS
    figures = {"inner_ratio": ratio, "white_share": dot_share, "dot_angle_deg": dot_deg}
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
    elif round(dot_deg, 6) < _MIN_DOT_DEG:
        problem = (
            f"the dots of {ring.name!r} are {dot_deg:.1f}° wide, seen from the centre; below"
            f" {_MIN_DOT_DEG:g}°, many rings are not found"
        )
    else:
        return
    yield mild(Cause.LAYOUT, problem, remedy, figures)


class SeenPrint(NamedTuple):
    """What one frame shows of a target's print."""

    target: str
    distance_m: float
    inner_growth: float | None  # as in `Appearance`
    dots_growth: float | None


def check_print(
    prints: Sequence[SeenPrint], targets: Sequence[AnyTarget], camera: Camera
) -> Iterator[Doubt]:
    """Yield the doubt about a printed inner circle or code that is not as stated for its ring.

    If one of them is wrong, the other seems to be, too, by a quarter of its growth or less and with
    the other sign. If the outer diameter is wrong, both grow alike, and the inner one is named.
    """
    for target in targets:
        if not isinstance(target, Target):
            continue
        of_target = [each for each in prints if each.target == target.name]
        ring = target.ring
        inner = _seen_growth(
            [(each.distance_m, each.inner_growth) for each in of_target],
            0.5 * ring.inner_diameter_m * camera.mean_focal_px,
        )
        dots = _seen_growth(
            [(each.distance_m, each.dots_growth) for each in of_target],
            0.5 * ring.code_diameter_m * camera.mean_focal_px,
        )
        if dots is not None and (inner is None or abs(dots.share) > 2.0 * abs(inner.share)):
            yield _doubt_about_dots(ring, dots)
        elif inner is not None:
            yield _doubt_about_inner_circle(ring, inner)


def _doubt_about_inner_circle(ring: Ring, growth: _Growth) -> Doubt:
    return mild(
        Cause.DIAMETERS,
        f"in {growth.frames} frames, the inner circle of {ring.name!r} is"
        f" {growth.amount} % too {'large' if growth.share > 0 else 'small'}"
        " for the outer one: diameters are not those of the print, and all distances are wrong"
        " by the same factor",
        "measure both diameters of the ring and give all lengths of [[target]] as printed"
        f" (for outer_diameter_m = {ring.outer_diameter_m:g}, an inner_diameter_m of about"
        f" {ring.inner_diameter_m * (1.0 + growth.share):.4g} would fit); a print at another scale"
        " changes all of them; if they are right, check response in [camera]",
        {"growth": growth.share, "sd_growth": growth.sd},
    )


def _doubt_about_dots(ring: Ring, growth: _Growth) -> Doubt:
    place, size = ("out", "large") if growth.share > 0 else ("in", "small")
    return mild(
        Cause.DIAMETERS,
        f"in {growth.frames} frames, the dots of {ring.name!r} are {growth.amount} % too far"
        f" {place} or too {size} for its ring: they are not those of the print, and all distances"
        " are wrong by the same factor",
        "measure the dots and the circle through their centres, and give dot_diameter_m and"
        " code_diameter_m as printed (if the dots have the stated size, a code_diameter_m of about"
        f" {ring.code_diameter_m * (1.0 + growth.share):.4g} would fit)",
        {"growth": growth.share, "sd_growth": growth.sd},
    )


@dataclass(frozen=True, slots=True)
class _Growth:
    """What the frames have in common: growth of a circle, and its standard deviation."""

    share: float
    sd: float
    frames: int

    @property
    def amount(self) -> str:
        """The absolute growth in percent, with the digits that are certain."""
        return amount(100.0 * abs(self.share), 100.0 * self.sd)


def _seen_growth(seen: Sequence[tuple[float, float | None]], radius_m_px: float) -> _Growth | None:
    """Return the growth that makes a print doubtful; None if it is not significant.

    Parameters
    ----------
    seen : sequence of (float, float or None)
        Distance [m] and growth in each sighting.
    radius_m_px : float
        Radius of the circle times the focal length [m px].
    """
    known = np.array([(distance_m, growth) for distance_m, growth in seen if growth is not None])
    if len(known) < _MIN_FRAMES:
        return None
    share, sd = _common_growth(known[:, 1], radius_m_px / known[:, 0])
    if abs(share) < max(_MIN_GROWTH, _MIN_RATIO * sd):
        return None
    return _Growth(share, sd, len(known))


def _common_growth(growth: FloatArray, radius_px: FloatArray) -> tuple[float, float]:
    """Return the growth that n frames have in common, and its standard deviation.

    Whatever displaces edges by the same number of pixels looks like a growth that is inversely
    proportional to the circle's radius, and is estimated with it. Frames count by the accuracy of
    an edge along a circle of their size, with Cauchy weights.
    """
    design = np.column_stack((np.ones_like(radius_px), 1.0 / radius_px)) * radius_px[:, None] ** 1.5
    seen = growth * radius_px**1.5
    values: FloatArray = np.zeros(2)
    for _ in range(_ROBUST_STEPS):
        residual = seen - design @ values
        variance = max(float(np.median(residual**2)) / _MEDIAN_CHI2, 1e-18)
        weight = 1.0 / (1.0 + residual**2 / (4.0 * variance))
        normal = (design * weight[:, None]).T @ design / variance
        normal[1, 1] += _SD_EDGE_PX**-2
        right_side = (design * weight[:, None]).T @ seen / variance
        values = np.asarray(np.linalg.solve(normal, right_side))
    return float(values[0]), math.sqrt(np.linalg.inv(normal)[0, 0])
