"""The numbers of the bias report: what figures and sentences show of the study."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.quality.bias_causes import Regression, regress
from kgcp.quality.bias_study import BiasStudy, Comparison, edge_distances
from kgcp.quality.exposure_effects import (
    QUANTITIES,
    ROUNDING,
    DistanceResiduals,
    Quantity,
    in_time,
    varies,
)
from kgcp.quality.statistics import Slope, Spread, fit_slope, wilson_interval
from kgcp.settings import Method

WORST, SPREAD = 12, 24
"""Numbers of close-ups: of the largest residuals, and evenly spread over the distances."""

BIN_M = 10.0
NEAR_M = 50.0  # the paper states accuracies below and above this distance
BIASED_SIGMAS = 3.0  # of noise and reference together; a larger error is a bias
_RADIUS_PX, _RADII_PER_OCTAVE = 13.0, 2.0  # borders at 13 px and at every factor of √2 from there


@dataclass(frozen=True, slots=True)
class RangeRow:
    """Errors of one range of reference distances."""

    label: str  # the range
    # of the errors [%] and [m]
    percent: Spread
    metres: Spread
    # mean standard deviation of the reference distances [%]; None: unknown
    sd_reference_percent: float | None
    # mean standard deviation by the camera's motion where it is unknown while a rolling shutter
    # reads frames [%]; 0: it is known
    sd_motion_percent: float = 0.0

    @property
    def sd_mean_percent(self) -> float | None:
        """Standard deviation of the mean error by its noise, the reference, and unknown motion [%].

        Errors of a trajectory and of reference poses are correlated over many frames, so averaging
        is not assumed to reduce them. A flight mostly has one speed: if it is unknown, its effect
        is that of all frames.
        """
        noise = self.percent.sd_mean
        if noise is None:
            return None
        return math.hypot(noise, self.sd_reference_percent or 0.0, self.sd_motion_percent)

    @property
    def is_biased(self) -> bool:
        """Whether noise, errors of the reference and unknown motion do not explain the mean."""
        sd = self.sd_mean_percent
        return sd is not None and abs(self.percent.mean) > BIASED_SIGMAS * sd

    @property
    def is_by_motion(self) -> bool:
        """Whether nothing but unknown motion explains the mean error."""
        return not self.is_biased and replace(self, sd_motion_percent=0.0).is_biased


@dataclass(frozen=True, slots=True)
class DetectionRate:
    """Share of the frames showing the target in which it was measured, for one range."""

    # borders of the range: of distances [m] or of radii [px]
    low: float
    high: float
    detected: int
    frames: int
    # of the rate, 0…1
    confidence_low: float
    confidence_high: float

    @property
    def rate(self) -> float:
        """Share of frames in which the target was found."""
        return self.detected / self.frames


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """One exposure quantity that varies, and what depends on it."""

    quantity: Quantity
    rows: IndexArray  # (m,): of the measurements that have it
    values: FloatArray  # (m,): as in the detections
    residual: Slope | None  # of the error [%] without scale and offset, per unit of the quantity
    edge_shift: Slope | None  # of δ [px], per unit of the quantity; None for δ itself


@dataclass(frozen=True, slots=True, eq=False)
class EdgeNumbers:
    """Distances by the outer edge alone, compared with those by both edges."""

    rows: IndexArray  # (m,): of the measurements that have both
    # (m,): residuals [m]
    outer_edge_m: FloatArray
    both_edges_m: FloatArray
    # of the residuals [%]
    outer_edge_percent: Spread
    both_edges_percent: Spread
    # of the distances by the outer edge; None also if these are the measured distances
    regression: Regression | None


@dataclass(frozen=True, slots=True, eq=False)
class BiasNumbers:
    """All numbers of one report."""

    compared: tuple[Comparison, ...]  # the trusted measurements, in the order of time
    data: DistanceResiduals  # of these measurements
    residual_percent: FloatArray  # (n,): errors in percent of the reference distance
    # (n,): part of them that the regression explains without exposure; 0 without a regression
    explained_percent: FloatArray
    # (n,): reported standard deviations of the errors, of measurement and reference; NaN where the
    # measurement has none
    sd_m: FloatArray
    total: RangeRow
    halves: tuple[RangeRow, ...]  # below and above 50 m
    bins: tuple[RangeRow, ...]  # per 10 m
    # per 10 m, and per radius of the ring
    rates: tuple[DetectionRate, ...]
    radius_rates: tuple[DetectionRate, ...]
    regression: Regression | None  # None: too few measurements, or distances too similar
    edges: EdgeNumbers | None  # None: no measurement has δ
    influences: tuple[Influence, ...]  # of the exposure quantities that vary
    standardised: Spread | None  # of the errors over their reported standard deviations
    sd_reference_m: float | None  # median standard deviation of the reference distances
    misplaced: tuple[str, ...]  # frames in which something else was measured
    # over all distances
    detected: int
    expected_visible: int
    left_out: tuple[tuple[str, int], ...]  # frames that were not compared: reasons and counts
    attitudes_agree: bool  # as in the study

    @property
    def frames(self) -> list[str]:
        """Names of the measurements' frames."""
        return [pair.attempt.frame for pair in self.compared]

    @property
    def biased(self) -> tuple[RangeRow, ...]:
        """The ranges with a bias: all distances, or else near or far ones."""
        return self._where(lambda row: row.is_biased)

    @property
    def biased_by_motion(self) -> tuple[RangeRow, ...]:
        """The ranges whose mean error nothing but unknown motion explains, as `biased`."""
        return self._where(lambda row: row.is_by_motion)

    def _where(self, holds: Callable[[RangeRow], bool]) -> tuple[RangeRow, ...]:
        """Return all distances if a condition holds for them, or else near or far ones."""
        return (self.total,) if holds(self.total) else tuple(filter(holds, self.halves))

    @property
    def is_displaced(self) -> bool:
        """Whether exposure displaces edges: δ differs from 0 by more than rounding."""
        shift = self.data.exposure["edge_shift_px"]
        return bool(np.any(np.abs(shift[np.isfinite(shift)]) > ROUNDING))

    @property
    def standardised_residuals(self) -> FloatArray:
        """Errors without scale and offset (n,), over their standard deviations."""
        remaining = self.residual_percent - self.explained_percent
        return np.asarray(
            remaining / (100.0 * np.sqrt(self.data.errors.total) / self.data.distance_m)
        )

    @property
    def worst(self) -> list[int]:
        """The rows of the largest standardised residuals, the largest first."""
        return largest(self.standardised_residuals)


def bias_numbers(study: BiasStudy) -> BiasNumbers:
    """Return the numbers of a study with at least one trusted measurement."""
    compared = in_time(study.trusted)
    measured = [pair.attempt.sighting for pair in compared if pair.attempt.sighting]
    data = DistanceResiduals.of(compared, np.array([sighting.distance_m for sighting in measured]))
    percent = 100.0 * data.residual_m / data.distance_m
    regression = regress(data)
    explained = np.zeros_like(percent)
    if regression is not None:
        explained = 100.0 * regression.systematic_m / data.distance_m
    sd_reference = np.array([pair.sds.total_m if pair.sds else np.nan for pair in compared])
    sd = np.sqrt(
        np.array([sighting.sd_distance_m for sighting in measured], dtype=float) ** 2
        + np.array([sighting.sd_common_distance_m or 0.0 for sighting in measured]) ** 2
        + np.nan_to_num(sd_reference) ** 2
    )
    sd_motion = np.array([pair.sd_motion_m for pair in compared])
    total, halves, bins = _range_rows(data.distance_m, data.residual_m, sd_reference, sd_motion)
    detected = [study.trusts(pair) for pair in study.expected_visible]
    scaled = (data.residual_m / sd)[np.isfinite(sd)]
    stated = sd_reference[np.isfinite(sd_reference)]
    left_out = Counter(absence.value for absence in study.absences)
    if study.frames_without_pose:
        left_out["no_reference_pose"] = len(study.frames_without_pose)
    if study.frames_with_vague_reference:
        left_out["vague_reference"] = len(study.frames_with_vague_reference)
    if study.frames_with_several_plates:
        left_out["second_plate"] = len(study.frames_with_several_plates)
    if study.frames_with_orienting_targets:
        left_out["static_targets_that_gave_the_poses"] = len(study.frames_with_orienting_targets)
    return BiasNumbers(
        compared=tuple(compared),
        data=data,
        residual_percent=percent,
        explained_percent=explained,
        sd_m=sd,
        total=total,
        halves=halves,
        bins=bins,
        rates=rates_by_distance(
            [pair.reference_distance_m for pair in study.expected_visible], detected
        ),
        radius_rates=rates_by_radius(
            [pair.expected_radius_px for pair in study.expected_visible], detected
        ),
        regression=regression,
        edges=_edges(study, compared),
        influences=_influences(data, percent - explained),
        standardised=Spread.of(scaled) if scaled.size else None,
        sd_reference_m=float(np.median(stated)) if stated.size else None,
        misplaced=tuple(pair.attempt.frame for pair in study.measured if not study.trusts(pair)),
        detected=sum(detected),
        expected_visible=len(detected),
        left_out=tuple(left_out.most_common()),
        attitudes_agree=study.attitudes_agree,
    )


def evenly(distance_m: FloatArray, count: int) -> list[int]:
    """Return up to `count` rows (n,), evenly spread over the ranks of distance, near to far."""
    ranked = np.argsort(distance_m, kind="stable")
    places = np.unique(np.linspace(0, len(ranked) - 1, min(count, len(ranked))).round())
    chosen: list[int] = ranked[places.astype(int)].tolist()
    return chosen


def largest(residual: FloatArray) -> list[int]:
    """Return the rows (n,) of the largest residuals, the largest first."""
    chosen: list[int] = np.argsort(-np.abs(residual), kind="stable")[:WORST].tolist()
    return chosen


def _range_rows(
    distance_m: FloatArray,
    residual_m: FloatArray,
    sd_reference_m: FloatArray,
    sd_motion_m: FloatArray,
) -> tuple[RangeRow, tuple[RangeRow, ...], tuple[RangeRow, ...]]:
    """Return the rows over all distances (n,), of near and far, and per 10 m.

    Standard deviations of the reference are NaN where they are not known.
    """

    def row(label: str, low: float, high: float) -> RangeRow | None:
        """Return the row of a range of distances [m]; None if it is empty."""
        inside = (distance_m >= low) & (distance_m < high)
        if not inside.any():
            return None
        distance, residual = distance_m[inside], residual_m[inside]
        relative = 100.0 * sd_reference_m[inside] / distance
        stated = relative[np.isfinite(relative)]
        sd = float(stated.mean()) if stated.size else None
        by_motion = float(np.mean(100.0 * sd_motion_m[inside] / distance))
        percent = Spread.of(100.0 * residual / distance)
        return RangeRow(label, percent, Spread.of(residual), sd, by_motion)

    total = row("over all distances", 0.0, math.inf)
    if total is None:
        raise ValueError("no distances")
    halves = (
        row(f"below {NEAR_M:.0f} m", 0.0, NEAR_M),
        row(f"{NEAR_M:.0f} m and more", NEAR_M, math.inf),
    )
    edges = np.unique(np.floor(distance_m / BIN_M)) * BIN_M
    bins = (row(f"{low:.0f}–{low + BIN_M:.0f} m", low, low + BIN_M) for low in edges)
    return total, tuple(filter(None, halves)), tuple(filter(None, bins))


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
    hits = Counter(step for step, hit in zip(steps, detected, strict=True) if hit)
    return tuple(
        DetectionRate(
            border(step),
            border(step + 1),
            hits[step],
            tried[step],
            *wilson_interval(hits[step], tried[step]),
        )
        for step in sorted(tried)
    )


def _edges(study: BiasStudy, compared: Sequence[Comparison]) -> EdgeNumbers | None:
    pairs = [edge_distances(pair, study.method) for pair in compared]
    rows = np.flatnonzero([pair is not None for pair in pairs])
    if not rows.size:
        return None
    with_both = [compared[row] for row in rows.tolist()]
    by_outer_m, by_both_m, radius_px = np.array(
        [astuple(pair) for pair in pairs if pair is not None]
    ).T
    by_outer = DistanceResiduals.of(with_both, by_outer_m, radius_px)
    return EdgeNumbers(
        rows=rows,
        outer_edge_m=by_outer.residual_m,
        both_edges_m=by_both_m - by_outer.distance_m,
        outer_edge_percent=Spread.of(100.0 * by_outer.residual_m / by_outer.distance_m),
        both_edges_percent=Spread.of(100.0 * (by_both_m / by_outer.distance_m - 1.0)),
        regression=None if study.method is Method.PAPER else regress(by_outer),
    )


def _influences(data: DistanceResiduals, percent: FloatArray) -> tuple[Influence, ...]:
    sd_percent = 100.0 * np.sqrt(data.errors.total) / data.distance_m
    shift = data.exposure["edge_shift_px"]
    influences = []
    for quantity in QUANTITIES:
        column = data.exposure[quantity.name]
        x = quantity.measure(column)
        rows = np.flatnonzero(np.isfinite(x))
        if not varies(x[rows]):
            continue
        both = rows[np.isfinite(shift[rows])]
        has_no_shift = quantity.name == "edge_shift_px" or not varies(shift[both])
        influences.append(
            Influence(
                quantity,
                rows,
                column[rows],
                fit_slope(x[rows], percent[rows], sd_percent[rows]),
                None
                if has_no_shift
                else fit_slope(x[both], shift[both], np.ones(len(both)), is_robust=False),
            )
        )
    return tuple(influences)
