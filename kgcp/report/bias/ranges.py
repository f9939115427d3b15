"""Residuals and detections per range of distances, and of radii of the ring."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.statistics import Spread, wilson_interval

BIN_M = 10.0
NEAR_M = 50.0  # the paper states its accuracy below and above
_BIASED_SIGMAS = 3.0
_RADIUS_PX, _RADII_PER_OCTAVE = 13.0, 2.0  # borders at 13 px and at every factor of √2 from there


@dataclass(frozen=True, slots=True)
class RangeRow:
    """Residuals of one range of reference distances, in percent and metres.

    Attributes
    ----------
    label : str
        The range.
    percent, metres : Spread
        Of the residuals.
    sd_reference_percent : float or None
        Mean standard deviation of the reference distances [%]; None where none is known.
    """

    label: str
    percent: Spread
    metres: Spread
    sd_reference_percent: float | None

    @property
    def is_biased(self) -> bool:
        """Whether the mean error stands out from its own noise and that of the reference.

        Errors of a trajectory and of reference poses last for many frames: averaging is not
        trusted to lessen them.
        """
        sd_mean = self.percent.sd_mean
        if sd_mean is None:
            return False
        sd = math.hypot(sd_mean, self.sd_reference_percent or 0.0)
        return abs(self.percent.mean) > _BIASED_SIGMAS * sd


@dataclass(frozen=True, slots=True)
class DetectionRate:
    """Detections among the chances of one range, with Wilson's 95 % interval.

    Attributes
    ----------
    low, high : float
        Borders of the range: of distances [m] or of radii [px].
    detected, frames : int
    confidence_low, confidence_high : float
        Of the rate, 0…1.
    """

    low: float
    high: float
    detected: int
    frames: int
    confidence_low: float
    confidence_high: float

    @property
    def rate(self) -> float:
        """Share of frames in which the target was found."""
        return self.detected / self.frames


def range_rows(
    distance_m: FloatArray, residual_m: FloatArray, sd_reference_m: FloatArray
) -> tuple[RangeRow, tuple[RangeRow, ...], tuple[RangeRow, ...]]:
    """Return the rows over all distances (n,), of near and far, and per 10 m.

    Standard deviations of the reference are NaN where they are not known.
    """
    edges = np.unique(np.floor(distance_m / BIN_M)) * BIN_M
    steps = [(f"{low:.0f}–{low + BIN_M:.0f} m", low, low + BIN_M) for low in edges]
    halves = [
        (f"below {NEAR_M:.0f} m", 0.0, NEAR_M),
        (f"{NEAR_M:.0f} m and more", NEAR_M, math.inf),
    ]

    def rows(ranges: Sequence[tuple[str, float, float]]) -> tuple[RangeRow, ...]:
        insides = [(distance_m >= low) & (distance_m < high) for _, low, high in ranges]
        return tuple(
            _row(label, distance_m[inside], residual_m[inside], sd_reference_m[inside])
            for (label, _, _), inside in zip(ranges, insides, strict=True)
            if inside.any()
        )

    (total,) = rows([("over all distances", 0.0, math.inf)])
    return total, rows(halves), rows(steps)


def _row(
    label: str, distance_m: FloatArray, residual_m: FloatArray, sd_reference_m: FloatArray
) -> RangeRow:
    percent = 100.0 * residual_m / distance_m
    relative = (100.0 * sd_reference_m / distance_m)[np.isfinite(sd_reference_m)]
    sd = float(relative.mean()) if relative.size else None
    return RangeRow(label, Spread.of(percent), Spread.of(residual_m), sd)


def rates_by_distance(
    distance_m: Sequence[float], detected: Sequence[bool]
) -> tuple[DetectionRate, ...]:
    """Count the detections per 10 m."""
    steps = [math.floor(distance / BIN_M) for distance in distance_m]
    return _rates(steps, detected, lambda step: BIN_M * step)


def rates_by_radius(
    radius_px: Sequence[float], detected: Sequence[bool]
) -> tuple[DetectionRate, ...]:
    """Count the detections per ring radius, in steps of a factor of √2."""
    steps = [math.floor(_RADII_PER_OCTAVE * math.log2(radius / _RADIUS_PX)) for radius in radius_px]
    return _rates(steps, detected, lambda step: _RADIUS_PX * 2.0 ** (step / _RADII_PER_OCTAVE))


def _rates(
    steps: Sequence[int], detected: Sequence[bool], border: Callable[[int], float]
) -> tuple[DetectionRate, ...]:
    tried = Counter(steps)
    found = Counter(step for step, hit in zip(steps, detected, strict=True) if hit)
    return tuple(
        DetectionRate(
            border(step),
            border(step + 1),
            found[step],
            tried[step],
            *wilson_interval(found[step], tried[step]),
        )
        for step in sorted(tried)
    )
