"""The corrections that best explain discrepancies, and which of them a flight can separate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.robust_gls import separable_unknowns, two_sided_probability

MAX_VARIANCE_FACTOR = 2.0
"""Variance factor up to which corrections explain a disagreement."""

_SIGNIFICANT = 0.001  # largest probability of a significant correction


@dataclass(frozen=True, slots=True)
class Unknown:
    """A setting that may be wrong by the same amount in all frames."""

    name: str  # with the unit of its value
    # Largest credible correction, in the unit of the adjustment. An unknown with a larger standard
    # deviation than this, even if it is estimated alone, is not determined.
    limit: float
    factor: float = 1.0  # converts the unit of the adjustment to that of the name
    # Largest inflation of its variance by the unknowns before it: its standard deviation may be
    # ten times larger than without them.
    max_inflation: float = 100.0
    is_scale: bool = False  # of the distances: estimated only if significant


UNKNOWNS = (
    Unknown("time_offset_s", 1.0),
    Unknown("lever_arm_forward_m", 2.0),
    Unknown("lever_arm_right_m", 2.0),
    Unknown("lever_arm_down_m", 2.0),
    Unknown("readout_s", 0.2),
    Unknown("boresight_x_deg", 0.2, math.degrees(1.0)),
    Unknown("boresight_y_deg", 0.2, math.degrees(1.0)),
    Unknown("boresight_z_deg", 0.2, math.degrees(1.0)),
    # Larger scales are among the mistakes that `kgcp.quality.checks.causes` tries, from 0.5 % on.
    Unknown("diameter_percent", 0.006, 100.0, max_inflation=10.0, is_scale=True),
    Unknown("focal_length_percent", 0.006, 100.0, max_inflation=10.0, is_scale=True),
)
"""Likeliest first: of unknowns that cannot be separated, the last is not estimated."""

READOUT = [unknown.name for unknown in UNKNOWNS].index("readout_s")
"""Column of the readout."""

UNKNOWN_LIMITS: FloatArray = np.array([unknown.limit for unknown in UNKNOWNS])
_MAX_INFLATIONS = [unknown.max_inflation for unknown in UNKNOWNS]


@dataclass(frozen=True, slots=True)
class Correction:
    """What to add to one setting, with its significance."""

    name: str  # of the unknown, with its unit
    # estimate and standard deviation; None: not determined by this flight
    value: float | None
    sd: float | None
    # of an estimate as large by chance, if nothing is wrong (Student's t, two-sided)
    probability: float | None
    # unknowns that this flight cannot separate from it: the estimate holds if they are right
    tangled_with: tuple[str, ...]
    # whether the estimate is within the unknown's limit; otherwise something else is wrong
    is_credible: bool

    @property
    def is_significant(self) -> bool:
        """Whether so large a value occurs by chance in less than one of a thousand flights."""
        return self.probability is not None and self.probability < _SIGNIFICANT


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionEstimate:
    """Corrections, and the sums of squares without and with them."""

    corrections: tuple[Correction, ...]  # in the order of `UNKNOWNS`
    # (10,): in the units of the adjustment, without what the equations already include; 0 where
    # not estimated
    values: FloatArray
    # sums of squares of the residuals over their stated standard deviations, without and with the
    # corrections
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: int  # of `chi2_after`

    @property
    def variance_factor(self) -> float:
        """χ² over its degrees of freedom: above 1 if errors are larger than stated."""
        return self.chi2_after / self.degrees_of_freedom


def estimate_corrections(
    products: FloatArray, count: int, *, has_sds: bool, readout_s: float = 0.0
) -> CorrectionEstimate:
    """Estimate the corrections from weighted products.

    Parameters
    ----------
    products : (12, 12) array
        Weighted products of twelve columns: those of the 10 unknowns, the discrepancy that they
        are to cancel, and the effect of one standard deviation of calibration and diameter, an
        error that all frames share.
    count : int
        Number of coordinates compared, three per frame.
    has_sds : bool
        Whether every error has a stated standard deviation. Then the scatter of the residuals can
        only enlarge the standard deviations of the corrections; otherwise it determines them.
    readout_s : float
        Correction of the readout that the equations already include.

    Notes
    -----
    A scale of the distances resembles the lever arm's part down. If both were always estimated,
    both could be too uncertain to be significant, and an error of either would go unnoticed.
    """
    fitted = _estimate(products, count, UNKNOWNS, readout_s, has_sds=has_sds)
    pairs = zip(UNKNOWNS, fitted.corrections, strict=True)
    if any(unknown.is_scale and found.is_significant for unknown, found in pairs):
        return fitted
    others = [unknown for unknown in UNKNOWNS if not unknown.is_scale]
    return _estimate(products, count, others, readout_s, has_sds=has_sds)


def _estimate(
    products: FloatArray,
    count: int,
    wanted: Sequence[Unknown],
    readout_s: float,
    *,
    has_sds: bool,
) -> CorrectionEstimate:
    """Estimate those corrections that are wanted and determined."""
    normal, observed, common = products[:-2, :-2], products[:-2, -2], products[:-2, -1]
    is_determined = np.diag(normal) * UNKNOWN_LIMITS**2 > 1.0
    determined = [i for i, each in enumerate(UNKNOWNS) if each in wanted and is_determined[i]]
    active, groups = separable_unknowns(normal, determined, _MAX_INFLATIONS)
    inverse = np.linalg.inv(normal[np.ix_(active, active)])
    values = np.zeros(len(UNKNOWNS))
    values[active] = -inverse @ observed[active]
    freedom = count - len(active)
    before = float(products[-2, -2])
    after = max(before + float(values @ observed), np.finfo(float).tiny)  # not below 0 by rounding
    factor = after / freedom
    cov = (max(1.0, factor) if has_sds else factor) * inverse
    shift = inverse @ common[active]
    sds = np.full(len(UNKNOWNS), np.nan)
    sds[active] = np.sqrt(np.diag(cov) + shift**2)
    included = np.zeros(len(UNKNOWNS))
    included[READOUT] = readout_s
    corrections = tuple(
        _correction(index, float((included + values)[index]), float(sds[index]), freedom, groups)
        for index in range(len(UNKNOWNS))
    )
    return CorrectionEstimate(corrections, values, before, after, freedom)


def _correction(
    index: int, value: float, sd: float, freedom: int, groups: Sequence[frozenset[int]]
) -> Correction:
    unknown = UNKNOWNS[index]
    others = sorted(set().union(*(group for group in groups if index in group)) - {index})
    names = tuple(UNKNOWNS[other].name for other in others)
    if math.isnan(sd):
        return Correction(unknown.name, None, None, None, names, is_credible=True)
    return Correction(
        unknown.name,
        value * unknown.factor,
        sd * unknown.factor,
        two_sided_probability(value / sd, freedom),
        names,
        is_credible=abs(value) <= unknown.limit,
    )
