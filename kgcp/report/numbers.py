"""The numbers of the bias report: what the study says, per range of distance and per exposure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.bias.statistics import RankCorrelation, Spread, rank_correlation, wilson_interval
from kgcp.bias.study import BiasStudy, Comparison
from kgcp.geometry.arrays import FloatArray

BIN_M = 10.0
_NEAR_M = 50.0  # the paper states its accuracy below and above
_BIASED_SIGMAS = 3.0
_RELATED_P = 0.01
_RELATED_RHO = 0.3
_ROUNDING = 1e-9  # a quantity that varies by less does not vary

QUANTITIES = {
    "black": "level of black",
    "white": "level of white",
    "saturated": "share of clipped pixels",
    "edge_shift_px": "edge shift δ [px]",
    "blur_px": "edge spread σ [px]",
    "exposure_time_s": "exposure time [s]",
    "iso": "ISO",
    "f_number": "f-number",
}
"""Exposure columns → axis labels."""


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
    """Detections among the chances of one range of distances, with Wilson's 95 % interval."""

    low_m: float
    high_m: float
    detected: int
    frames: int
    confidence_low: float
    confidence_high: float

    @property
    def rate(self) -> float:
        """Share of frames in which the target was found."""
        return self.detected / self.frames


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """Residuals against one exposure quantity.

    Attributes
    ----------
    label : str
        What it is, with its unit.
    values, residual_percent : (n,) array
        Pairs of the frames that have the quantity.
    correlation : RankCorrelation or None
        None for fewer than 8 pairs or a constant.
    """

    label: str
    values: FloatArray
    residual_percent: FloatArray
    correlation: RankCorrelation | None

    @property
    def is_clear(self) -> bool:
        """Whether the residual follows this quantity beyond chance."""
        found = self.correlation
        return found is not None and found.p_value < _RELATED_P and abs(found.rho) > _RELATED_RHO


@dataclass(frozen=True, slots=True, eq=False)
class BiasNumbers:
    """All numbers of one report.

    Attributes
    ----------
    distance_m, residual_m, residual_percent : (n,) array
        Of the trusted measurements.
    total : RangeRow
    halves : tuple of RangeRow
        Below and above 50 m.
    bins : tuple of RangeRow
        Per 10 m.
    rates : tuple of DetectionRate
        Per 10 m.
    influences : tuple of Influence
        Of the exposure quantities that vary.
    sd_reference_m : float or None
        Median standard deviation of the reference distances.
    astray : tuple of str
        Frames in which something else was measured.
    detected, chances : int
        Over all distances.
    left_out : tuple of (str, int)
        Frames that could not be compared: why and how many.
    attitudes_agree : bool
        As in the study.
    """

    distance_m: FloatArray
    residual_m: FloatArray
    residual_percent: FloatArray
    total: RangeRow
    halves: tuple[RangeRow, ...]
    bins: tuple[RangeRow, ...]
    rates: tuple[DetectionRate, ...]
    influences: tuple[Influence, ...]
    sd_reference_m: float | None
    astray: tuple[str, ...]
    detected: int
    chances: int
    left_out: tuple[tuple[str, int], ...]
    attitudes_agree: bool

    @property
    def biased(self) -> tuple[RangeRow, ...]:
        """The ranges whose mean error stands out from its own noise: all, or halves of it."""
        if self.total.is_biased:
            return (self.total,)
        return tuple(half for half in self.halves if half.is_biased)


def bias_numbers(study: BiasStudy) -> BiasNumbers:
    """Reduce a study to its numbers; at least one trusted measurement is needed."""
    trusted = study.trusted
    distance = np.array([one.reference_distance_m for one in trusted])
    residual = np.array([one.residual_m for one in trusted], dtype=np.float64)
    percent = 100.0 * residual / distance
    sds = np.array([one.sd_reference_m for one in trusted], dtype=np.float64)  # NaN: not known
    known = np.isfinite(sds)
    edges = np.unique(np.floor(distance / BIN_M)) * BIN_M

    def rows(*ranges: tuple[str, float, float]) -> tuple[RangeRow, ...]:
        insides = [(distance >= low) & (distance < high) for _, low, high in ranges]
        return tuple(
            RangeRow(
                label,
                Spread.of(percent[inside]),
                Spread.of(residual[inside]),
                _mean_or_none((100.0 * sds / distance)[inside & known]),
            )
            for (label, _, _), inside in zip(ranges, insides, strict=True)
            if inside.any()
        )

    (total,) = rows(("over all distances", 0.0, math.inf))
    detected = [study.trusts(one) for one in study.chances]
    return BiasNumbers(
        distance_m=distance,
        residual_m=residual,
        residual_percent=percent,
        total=total,
        halves=rows(("below 50 m", 0.0, _NEAR_M), ("50 m and more", _NEAR_M, math.inf)),
        bins=rows(*((f"{low:.0f}–{low + BIN_M:.0f} m", low, low + BIN_M) for low in edges)),
        rates=_rates(np.array([one.reference_distance_m for one in study.chances]), detected),
        influences=_influences(trusted, percent),
        sd_reference_m=float(np.median(sds[known])) if known.any() else None,
        astray=tuple(one.attempt.frame for one in study.measured if not study.trusts(one)),
        detected=sum(detected),
        chances=len(detected),
        left_out=_left_out(study),
        attitudes_agree=study.attitudes_agree,
    )


def _mean_or_none(values: FloatArray) -> float | None:
    return float(values.mean()) if values.size else None


def _rates(distance_m: FloatArray, detected: Sequence[bool]) -> tuple[DetectionRate, ...]:
    found: Counter[int] = Counter()
    tried: Counter[int] = Counter()
    for distance, hit in zip(distance_m, detected, strict=True):
        tried[int(distance // BIN_M)] += 1
        found[int(distance // BIN_M)] += hit
    return tuple(
        DetectionRate(
            BIN_M * step,
            BIN_M * (step + 1),
            found[step],
            tried[step],
            *wilson_interval(found[step], tried[step]),
        )
        for step in sorted(tried)
    )


def _influences(trusted: Sequence[Comparison], percent: FloatArray) -> tuple[Influence, ...]:
    influences = []
    for name, label in QUANTITIES.items():
        column = np.array(
            [getattr(one.attempt.exposure, name) for one in trusted], dtype=np.float64
        )
        known = np.isfinite(column)
        values = column[known]
        if len(values) > 1 and np.ptp(values) > _ROUNDING:
            residual = percent[known]
            influences.append(
                Influence(label, values, residual, rank_correlation(values, residual))
            )
    return tuple(influences)


def _left_out(study: BiasStudy) -> tuple[tuple[str, int], ...]:
    reasons = Counter(absence.value for absence in study.absences)
    if study.frames_without_pose:
        reasons["no_reference_pose"] = len(study.frames_without_pose)
    return tuple(reasons.most_common())
