"""Corrections that explain discrepancies best, and which of them a flight can tell apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.robust_gls import separable, two_sided

_MAX_INFLATION = 100.0  # of a variance by the other unknowns: a standard deviation ten times larger
_SIGNIFICANT = 0.001


@dataclass(frozen=True, slots=True)
class Unknown:
    """One thing that may be wrong in the same way in all frames."""

    name: str  # with the unit of its value
    # beyond belief, in the unit of the adjustment; an unknown whose standard deviation alone is
    # larger is not determined
    limit: float
    factor: float = 1.0  # from the unit of the adjustment to that of the name


UNKNOWNS = (
    Unknown("time_offset_s", 1.0),
    Unknown("lever_arm_forward_m", 2.0),
    Unknown("lever_arm_right_m", 2.0),
    Unknown("lever_arm_down_m", 2.0),
    Unknown("readout_s", 0.2),
    Unknown("boresight_x_deg", 0.2, math.degrees(1.0)),
    Unknown("boresight_y_deg", 0.2, math.degrees(1.0)),
    Unknown("boresight_z_deg", 0.2, math.degrees(1.0)),
)
"""In the order in which they are believed: of those that look alike the last is given up."""

UNKNOWN_LIMITS: FloatArray = np.array([unknown.limit for unknown in UNKNOWNS])


@dataclass(frozen=True, slots=True)
class Correction:
    """What to add to one setting, and how sure that is."""

    name: str  # of the unknown, with its unit
    # estimate and standard deviation; None: not determined by this flight
    value: float | None
    sd: float | None
    # of an estimate as large by chance, where nothing is wrong (Student's t, both sides)
    probability: float | None
    # unknowns that look alike in this flight: the estimate holds if they are right
    tangled_with: tuple[str, ...]
    # whether the estimate is within the unknown's limit; beyond, something else is wrong
    is_credible: bool

    @property
    def is_significant(self) -> bool:
        """Whether chance would give such a value less than once in a thousand flights."""
        return self.probability is not None and self.probability < _SIGNIFICANT


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionEstimate:
    """Corrections, and the residuals' size without and with them."""

    corrections: tuple[Correction, ...]  # in the order of `UNKNOWNS`
    values: FloatArray  # (8,): in the units of the adjustment; 0 where not estimated
    # sum of squares without and with the corrections, by the stated standard deviations
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: int  # of `chi2_after`

    @property
    def variance_factor(self) -> float:
        """χ² over its degrees of freedom: above 1 where errors are larger than stated."""
        return self.chi2_after / self.degrees_of_freedom


def estimate_corrections(products: FloatArray, count: int, *, has_sds: bool) -> CorrectionEstimate:
    """Estimate the corrections from weighted products.

    Parameters
    ----------
    products : (10, 10) array
        Of the columns of the 8 unknowns, the discrepancy that they are to cancel, and the effect of
        one standard deviation of calibration and diameter, an error that all frames share.
    count : int
        Coordinates compared, three per frame.
    has_sds : bool
        Whether every error has a stated standard deviation. Otherwise the residuals set the scale
        alone; with them they only enlarge it.
    """
    normal, observed, common = products[:-2, :-2], products[:-2, -2], products[:-2, -1]
    visible = np.flatnonzero(np.diag(normal) * UNKNOWN_LIMITS**2 > 1.0).tolist()
    active, tangles = separable(normal, visible, [_MAX_INFLATION] * len(UNKNOWNS))
    inverse = np.linalg.inv(normal[np.ix_(active, active)])
    values = np.zeros(len(UNKNOWNS))
    values[active] = -inverse @ observed[active]
    freedom = count - len(active)
    before = float(products[-2, -2])
    after = max(before + float(values @ observed), np.finfo(float).tiny)  # rounding may go below 0
    factor = after / freedom
    cov = (max(1.0, factor) if has_sds else factor) * inverse
    shift = inverse @ common[active]
    sds = np.full(len(UNKNOWNS), np.nan)
    sds[active] = np.sqrt(np.diag(cov) + shift**2)
    corrections = tuple(
        _correction(index, float(values[index]), float(sds[index]), freedom, tangles)
        for index in range(len(UNKNOWNS))
    )
    return CorrectionEstimate(corrections, values, before, after, freedom)


def _correction(
    index: int, value: float, sd: float, freedom: int, tangles: Sequence[frozenset[int]]
) -> Correction:
    unknown = UNKNOWNS[index]
    alike = sorted(set().union(*(group for group in tangles if index in group)) - {index})
    names = tuple(UNKNOWNS[other].name for other in alike)
    if math.isnan(sd):
        return Correction(unknown.name, None, None, None, names, is_credible=True)
    return Correction(
        unknown.name,
        value * unknown.factor,
        sd * unknown.factor,
        two_sided(value / sd, freedom),
        names,
        is_credible=abs(value) <= unknown.limit,
    )
