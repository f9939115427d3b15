"""Corrections that explain discrepancies best, and which of them a flight can tell apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from kgcp.geometry.arrays import BoolArray, FloatArray

_MAX_INFLATION = 100.0  # of a variance by the other unknowns: a deviation ten times larger
_TANGLED_SHARE = 0.3
_SIGNIFICANT = 0.001
_CHI2_3_MEDIAN = 2.366
_OUTLIER_CHI2 = 25.0  # of three coordinates: exceeded by chance once in 65 000
_ROBUST_ROUNDS = 30


@dataclass(frozen=True, slots=True)
class Unknown:
    """One thing that may be wrong in the same way in all frames.

    Attributes
    ----------
    name : str
        With the unit of its value.
    limit : float
        Beyond belief, in the unit of the adjustment; one whose deviation alone is larger is not
        determined.
    factor : float
        From the unit of the adjustment to that of the name.
    """

    name: str
    limit: float
    factor: float = 1.0


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


@dataclass(frozen=True, slots=True)
class Correction:
    """What to add to one setting, and how sure that is.

    Attributes
    ----------
    name : str
        Of the unknown, with its unit.
    value, sd : float or None
        Estimate and standard deviation; None: not determined by this flight.
    probability : float or None
        Of an estimate as large by chance, where nothing is wrong (Student's t, both sides).
    tangled_with : tuple of str
        Unknowns that look alike in this flight: the estimate holds if they are right.
    is_credible : bool
        Whether the estimate is within the unknown's limit; beyond, something else is wrong.
    """

    name: str
    value: float | None
    sd: float | None
    probability: float | None
    tangled_with: tuple[str, ...]
    is_credible: bool

    @property
    def is_significant(self) -> bool:
        """Whether chance would give such a value less than once in a thousand flights."""
        return self.probability is not None and self.probability < _SIGNIFICANT


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Corrections with what remains.

    Attributes
    ----------
    corrections : tuple of Correction
        In the order of `UNKNOWNS`.
    values : (8,) array
        In the units of the adjustment; 0 where not estimated.
    chi2_before, chi2_after : float
        Sum of squares without and with the corrections, by the stated deviations.
    degrees_of_freedom : int
        Of `chi2_after`.
    """

    corrections: tuple[Correction, ...]
    values: FloatArray
    chi2_before: float
    chi2_after: float
    degrees_of_freedom: int

    @property
    def variance_factor(self) -> float:
        """χ² over its degrees of freedom: above 1 where the stated deviations are too small."""
        return self.chi2_after / self.degrees_of_freedom


def find_outliers(design: FloatArray, observed: FloatArray, cov_m2: FloatArray) -> BoolArray:
    """Return which of n points fit no correction, (n,) of booleans.

    A fit by Cauchy's weights, point by point, of design (n, 3, 8) to observed (n, 3). Errors are
    taken as independent, which does no harm to the distinction.
    """
    half = np.linalg.cholesky(cov_m2)
    rows, right = np.linalg.solve(half, design), np.linalg.solve(half, observed[:, :, None])
    limits = np.array([unknown.limit for unknown in UNKNOWNS])
    weight = np.ones(len(observed))
    for _ in range(_ROBUST_ROUNDS):
        weighted = (weight[:, None, None] * rows).reshape(-1, len(limits))
        normal = weighted.T @ rows.reshape(-1, len(limits)) + np.diag(limits**-2.0)
        values = -np.linalg.solve(normal, weighted.T @ right.ravel())
        squares = np.sum((right[:, :, 0] + rows @ values) ** 2, axis=1)
        scale = max(1.0, float(np.median(squares)) / _CHI2_3_MEDIAN)
        weight = 1.0 / (1.0 + squares / (3.0 * scale))
    return np.asarray(squares > _OUTLIER_CHI2 * scale)


def estimate(whitened: FloatArray, *, has_deviations: bool) -> Estimate:
    """Estimate the corrections from whitened rows.

    Parameters
    ----------
    whitened : (m, 10) array
        Columns of the 8 unknowns, the discrepancy that they are to cancel, and the effect of one
        deviation of calibration and diameter, an error that all frames share.
    has_deviations : bool
        Whether every error has a stated deviation. Otherwise the residuals set the scale alone;
        with them they only enlarge it.
    """
    rows, observed, common = whitened[:, :-2], whitened[:, -2], whitened[:, -1]
    normal = rows.T @ rows
    active, tangles = _separable(normal)
    inverse = np.linalg.inv(normal[np.ix_(active, active)])
    solve = -inverse @ rows[:, active].T
    values = np.zeros(len(UNKNOWNS))
    values[active] = solve @ observed
    freedom = len(observed) - len(active)
    after = float(np.sum((observed + rows @ values) ** 2))
    factor = after / freedom
    cov = (max(1.0, factor) if has_deviations else factor) * inverse
    shift = solve @ common
    deviations = np.full(len(UNKNOWNS), np.nan)
    deviations[active] = np.sqrt(np.diag(cov) + shift**2)
    corrections = tuple(
        _correction(index, float(values[index]), float(deviations[index]), freedom, tangles)
        for index in range(len(UNKNOWNS))
    )
    return Estimate(corrections, values, float(observed @ observed), after, freedom)


def _correction(
    index: int, value: float, sd: float, freedom: int, tangles: Sequence[frozenset[int]]
) -> Correction:
    unknown = UNKNOWNS[index]
    alike = sorted(set().union(*(group for group in tangles if index in group)) - {index})
    names = tuple(UNKNOWNS[other].name for other in alike)
    if math.isnan(sd):
        return Correction(unknown.name, None, None, None, names, is_credible=True)
    probability = float(2.0 * stdtr(freedom, -abs(value) / sd))
    return Correction(
        unknown.name,
        value * unknown.factor,
        sd * unknown.factor,
        probability,
        names,
        is_credible=abs(value) <= unknown.limit,
    )


def _separable(normal: FloatArray) -> tuple[list[int], list[frozenset[int]]]:
    """Return the unknowns that can be estimated together, and the groups that look alike.

    As long as the others inflate the variance of an unknown by more than `_MAX_INFLATION`, the
    weakest eigenvector of the normal matrix, scaled to a unit diagonal, names a group; its last
    member is given up.
    """
    known = [normal[j, j] * unknown.limit**2 > 1.0 for j, unknown in enumerate(UNKNOWNS)]
    active = [int(index) for index in np.flatnonzero(known)]
    tangles = []
    while len(active) > 1:
        part = normal[np.ix_(active, active)]
        size = np.sqrt(np.diag(part))
        eigenvalues, vectors = np.linalg.eigh(part / np.outer(size, size))
        inflation = np.sum(vectors**2 / np.maximum(eigenvalues, 1e-15), axis=1)
        if inflation.max() <= _MAX_INFLATION:
            break
        weakest = np.abs(vectors[:, 0])
        group = [active[k] for k in np.flatnonzero(weakest > _TANGLED_SHARE * weakest.max())]
        tangles.append(frozenset(group))
        active.remove(group[-1])
    return active, tangles
