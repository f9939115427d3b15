"""The numbers of the bias report: what the study says, as far as it goes into figures and words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.quality.bias_causes import Regression, regress
from kgcp.quality.bias_study import BiasStudy, Comparison, edge_distances
from kgcp.quality.exposure_effects import (
    QUANTITIES,
    ROUNDING,
    Quantity,
    DistanceResiduals,
    in_time,
    varies,
)
from kgcp.quality.statistics import Slope, Spread, fit_slope
from kgcp.report.bias.ranges import (
    DetectionRate,
    RangeRow,
    range_rows,
    rates_by_distance,
    rates_by_radius,
)
from kgcp.settings import Method


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """One exposure quantity that varies, and what follows it.

    Attributes
    ----------
    quantity : Quantity
    rows : (m,) array of int
        Of the measurements that have it.
    values : (m,) array
        As in the detections.
    residual : Slope or None
        Of the error [%], without scale and offset, by the quantity's own unit.
    edge_shift : Slope or None
        Of δ [px], the same; None for δ itself.
    """

    quantity: Quantity
    rows: IndexArray
    values: FloatArray
    residual: Slope | None
    edge_shift: Slope | None


@dataclass(frozen=True, slots=True, eq=False)
class EdgeNumbers:
    """Distances by one edge against those by two.

    Attributes
    ----------
    rows : (m,) array of int
        Of the measurements that have both.
    one_m, two_m : (m,) array
        DistanceResiduals [m].
    one_percent, two_percent : Spread
        Of the residuals [%].
    regression : Regression or None
        Of the distances by one edge; None, too, where these are what was measured.
    """

    rows: IndexArray
    one_m: FloatArray
    two_m: FloatArray
    one_percent: Spread
    two_percent: Spread
    regression: Regression | None


@dataclass(frozen=True, slots=True, eq=False)
class BiasNumbers:
    """All numbers of one report.

    Attributes
    ----------
    compared : tuple of Comparison
        The n trusted measurements, in time.
    data : DistanceResiduals
        Theirs.
    residual_percent : (n,) array
        Of the reference distance.
    explained_percent : (n,) array
        What the regression explains of it without exposure; 0 without a regression.
    sd_m : (n,) array
        Reported standard deviations of the residuals, of measurement and reference; NaN where
        the measurement has none.
    total : RangeRow
    halves : tuple of RangeRow
        Below and above 50 m.
    bins : tuple of RangeRow
        Per 10 m.
    rates, radius_rates : tuple of DetectionRate
        Per 10 m, and per radius of the ring.
    regression : Regression or None
        None where there is too little for one.
    edges : EdgeNumbers or None
        None where no measurement has δ.
    influences : tuple of Influence
        Of the exposure quantities that vary.
    standardised : Spread or None
        Of residuals over reported deviations.
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

    compared: tuple[Comparison, ...]
    data: DistanceResiduals
    residual_percent: FloatArray
    explained_percent: FloatArray
    sd_m: FloatArray
    total: RangeRow
    halves: tuple[RangeRow, ...]
    bins: tuple[RangeRow, ...]
    rates: tuple[DetectionRate, ...]
    radius_rates: tuple[DetectionRate, ...]
    regression: Regression | None
    edges: EdgeNumbers | None
    influences: tuple[Influence, ...]
    standardised: Spread | None
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

    @property
    def is_displaced(self) -> bool:
        """Whether exposure displaces edges: δ differs from 0 by more than rounding."""
        shift = self.data.exposure["edge_shift_px"]
        return bool(np.any(np.abs(shift[np.isfinite(shift)]) > ROUNDING))

    @property
    def standardised_residuals(self) -> FloatArray:
        """DistanceResiduals (n,) over their reported deviations; NaN where there is none."""
        return self.data.residual_m / self.sd_m


def bias_numbers(study: BiasStudy) -> BiasNumbers:
    """Reduce a study to its numbers; at least one trusted measurement is needed."""
    compared = in_time(study.trusted)
    data = DistanceResiduals.of(compared, _measured_m(compared))
    percent = 100.0 * data.residual_m / data.distance_m
    regression = regress(data)
    explained = np.zeros_like(percent)
    if regression is not None:
        explained = 100.0 * regression.systematic_m / data.distance_m
    sd_reference = np.array([one.sds.total_m if one.sds else np.nan for one in compared])
    sd = _reported_sd_m(compared)
    total, halves, bins = range_rows(data.distance_m, data.residual_m, sd_reference)
    detected = [study.trusts(one) for one in study.chances]
    scaled = (data.residual_m / sd)[np.isfinite(sd)]
    return BiasNumbers(
        compared=tuple(compared),
        data=data,
        residual_percent=percent,
        explained_percent=explained,
        sd_m=sd,
        total=total,
        halves=halves,
        bins=bins,
        rates=rates_by_distance([one.reference_distance_m for one in study.chances], detected),
        radius_rates=rates_by_radius([one.expected_radius_px for one in study.chances], detected),
        regression=regression,
        edges=_edges(study, compared),
        influences=_influences(data, percent - explained),
        standardised=Spread.of(scaled) if scaled.size else None,
        sd_reference_m=_median(sd_reference[np.isfinite(sd_reference)]),
        astray=tuple(one.attempt.frame for one in study.measured if not study.trusts(one)),
        detected=sum(detected),
        chances=len(detected),
        left_out=_left_out(study),
        attitudes_agree=study.attitudes_agree,
    )


def _measured_m(compared: Sequence[Comparison]) -> FloatArray:
    return np.array([one.attempt.sighting.distance_m for one in compared if one.attempt.sighting])


def _reported_sd_m(compared: Sequence[Comparison]) -> FloatArray:
    """Return what measurement and reference say of their deviations, errors in common included."""
    seen = [one.attempt.sighting for one in compared]
    own = np.array([np.nan if one is None else one.sd_distance_m for one in seen], dtype=float)
    common = np.array([(one and one.sd_common_distance_m) or 0.0 for one in seen])
    reference = np.array([one.sds.total_m if one.sds else 0.0 for one in compared])
    return np.asarray(np.sqrt(own**2 + common**2 + reference**2))


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if values.size else None


def _edges(study: BiasStudy, compared: Sequence[Comparison]) -> EdgeNumbers | None:
    pairs = [edge_distances(one, study.method) for one in compared]
    rows = np.flatnonzero([pair is not None for pair in pairs])
    if not rows.size:
        return None
    with_both = [compared[row] for row in rows.tolist()]
    one_m, two_m, one_px = np.array([astuple(pair) for pair in pairs if pair is not None]).T
    by_one = DistanceResiduals.of(with_both, one_m, one_px)
    return EdgeNumbers(
        rows=rows,
        one_m=by_one.residual_m,
        two_m=two_m - by_one.distance_m,
        one_percent=Spread.of(100.0 * by_one.residual_m / by_one.distance_m),
        two_percent=Spread.of(100.0 * (two_m / by_one.distance_m - 1.0)),
        regression=None if study.method is Method.PAPER else regress(by_one),
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
        own = quantity.name == "edge_shift_px" or not varies(shift[both])
        influences.append(
            Influence(
                quantity,
                rows,
                column[rows],
                fit_slope(x[rows], percent[rows], sd_percent[rows]),
                None
                if own
                else fit_slope(x[both], shift[both], np.ones(len(both)), is_robust=False),
            )
        )
    return tuple(influences)


def _left_out(study: BiasStudy) -> tuple[tuple[str, int], ...]:
    reasons = Counter(absence.value for absence in study.absences)
    if study.frames_without_pose:
        reasons["no_reference_pose"] = len(study.frames_without_pose)
    return tuple(reasons.most_common())
