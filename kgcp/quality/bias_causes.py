"""Causes of the residuals of distances: a scale, an offset, and effects of exposure on edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.quality.exposure_effects import QUANTITIES, DistanceResiduals, varies
from kgcp.quality.robust_gls import RegressionFit, fit, separable_unknowns, two_sided_probability

SIGNIFICANT = 0.01
"""Largest probability of a significant term, corrected for the number of terms."""

MIN_COUNT = 6  # residuals
_MIN_PER_TERM = 4  # residuals per term, for effects of exposure
_MIN_KNOWN_SHARE = 0.9  # of the frames in which a quantity must be known
# Largest inflation of a term's variance by the other terms: standard deviations may be five times
# larger than without them. The terms that depend on the distance only may be inflated more, because
# they are always estimated.
_MAX_INFLATION = 25.0
_MAX_INFLATION_BY_DISTANCE = 1000.0
_CURVATURE = "edge_curvature_px2"
# Least squared correlation, after scale and offset, with which the effect of a quantity that is not
# estimated looks like that of another one.
_ALIKE = 0.5


@dataclass(frozen=True, slots=True)
class Term:
    """One cause with its estimated amount."""

    name: str  # `scale`, `offset_m`, `edge_curvature_px2`, or a column of the exposure
    # Estimate and standard deviation. `scale` is relative, `offset_m` in metres,
    # `edge_curvature_px2` the displacement of the edge times its radius [px²]; the others are
    # displacements of the edge in pixels per unit of their quantity.
    value: float
    sd: float
    # of a value as large by chance (Student's t, two-sided), with Holm's correction for the number
    # of terms
    probability: float
    # quantities that are not estimated and vary like that of the term, so that the effect may be
    # theirs instead
    alike: tuple[str, ...] = ()

    @property
    def is_significant(self) -> bool:
        """Whether it is unlikely to be chance."""
        return self.probability < SIGNIFICANT


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Fit of residual = scale · distance + offset + effects of displaced edges."""

    terms: tuple[Term, ...]  # `scale` first
    # quantities that vary together with others, so that their effects cannot be separated
    tangled: tuple[str, ...]
    count: int  # residuals that were fitted
    used: BoolArray  # (n,): rows that have all quantities
    outlier: BoolArray  # (n,): those of them that were left out as outliers
    # standard deviation of the residuals about a plain fit, over the stated ones; 1 if these are
    # right
    scatter: float
    correlation_s: float  # as in `RegressionFit`
    # share of the variance after scale and offset that the terms of exposure explain, corrected
    # for their number; 0 without such terms
    exposure_share: float
    # of as large a share by chance (F test); None without such terms
    exposure_probability: float | None
    systematic_m: FloatArray  # (n,): the plain fit without its terms of exposure [m]

    @property
    def exposure_terms(self) -> tuple[Term, ...]:
        """The terms of exposure."""
        names = {quantity.name for quantity in QUANTITIES}
        return tuple(term for term in self.terms if term.name in names)

    @property
    def is_exposure_significant(self) -> bool:
        """Whether any effect of exposure is significant."""
        return any(term.is_significant for term in self.exposure_terms)


def regress(data: DistanceResiduals) -> Regression | None:
    """Separate the causes of residuals; None if there are too few, or if distances do not vary.

    An edge displaced by ε px changes the distance D by D ε / R, where R is the ring's radius in px.
    Since R ∝ 1/D, this grows with the square of the distance. Each exposure quantity x therefore
    has the column (x − mean) D / R. The edge shift δ is a displacement itself, and has the column
    δ D / R. Blur displaces curved edges by σ² / 2R. Its column, D / R², is tried last, and kept if
    it is significant.
    """
    if len(data.residual_m) < MIN_COUNT or not varies(data.residual_m):
        return None
    columns, used = _columns(data)
    weight = 1.0 / np.sqrt(data.errors.total)
    names = _separable_names(columns, used, weight, int(np.count_nonzero(used)) // _MIN_PER_TERM)
    if "offset_m" not in names:
        return None
    tangled = tuple(name for name in columns if name not in names)
    result = _fit(data, columns, names, used)
    extended = {**columns, _CURVATURE: data.distance_m / data.radius_px**2}
    more = _separable_names(extended, used, weight, len(used))
    if set(more) >= {*names, _CURVATURE} and used.sum() > _MIN_PER_TERM * (len(names) + 1):
        other = _fit(data, extended, [*names, _CURVATURE], used)
        if _terms([*names, _CURVATURE], other)[-1].is_significant:
            names, columns, result = [*names, _CURVATURE], extended, other
    return _regression(data, columns, names, tangled, used, result)


def _columns(data: DistanceResiduals) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the columns of all terms that vary, and the rows that have all of them."""
    per_px = data.distance_m / data.radius_px
    columns = {"scale": data.distance_m, "offset_m": np.ones_like(data.distance_m)}
    used = np.ones(len(data.distance_m), dtype=bool)
    for quantity in QUANTITIES:
        values = quantity.measure(data.exposure[quantity.name])
        present = np.isfinite(values)
        if present.mean() < _MIN_KNOWN_SHARE or not varies(values[present]):
            continue
        used &= present
        zero = 0.0 if quantity.is_absolute else float(np.mean(values[present]))
        columns[quantity.name] = (values - zero) * per_px
    return columns, used


def _separable_names(
    columns: dict[str, FloatArray], used: BoolArray, weight: FloatArray, max_count: int
) -> list[str]:
    """Return the names of the terms that can be estimated together, `max_count` at most."""
    rows = np.column_stack(list(columns.values()))[used] * weight[used, None]
    names = list(columns)
    limits = [
        _MAX_INFLATION_BY_DISTANCE if name in {"offset_m", _CURVATURE} else _MAX_INFLATION
        for name in names
    ]
    active, _ = separable_unknowns(rows.T @ rows, np.flatnonzero(rows.any(axis=0)).tolist(), limits)
    return [names[index] for index in active[: max(2, max_count)]]


def _fit(
    data: DistanceResiduals, columns: dict[str, FloatArray], names: Sequence[str], used: BoolArray
) -> RegressionFit:
    design = np.column_stack([columns[name] for name in names])[used]
    return fit(design, data.residual_m[used], data.errors.kept(used))


def _terms(names: Sequence[str], result: RegressionFit) -> tuple[Term, ...]:
    p_values = [
        two_sided_probability(float(value / sd), result.freedom)
        for value, sd in zip(result.values, result.sds, strict=True)
    ]
    return tuple(
        Term(name, float(value), float(sd), chance)
        for name, value, sd, chance in zip(
            names, result.values, result.sds, holm(p_values), strict=True
        )
    )


def holm(probabilities: Sequence[float]) -> list[float]:
    """Correct the probabilities of several tests (Holm 1979, Scand. J. Statist. 6, 65–70)."""
    corrected = [0.0] * len(probabilities)
    largest = 0.0
    ranked = sorted(range(len(probabilities)), key=lambda index: probabilities[index])
    for rank, index in enumerate(ranked):
        largest = max(largest, min(1.0, (len(probabilities) - rank) * probabilities[index]))
        corrected[index] = largest
    return corrected


def _regression(
    data: DistanceResiduals,
    columns: dict[str, FloatArray],
    names: list[str],
    tangled: tuple[str, ...],
    used: BoolArray,
    result: RegressionFit,
) -> Regression:
    """Describe a fit: its terms, its scatter, and what exposure explains.

    An error that lasts longer than the flight acts like an offset, and the fit cannot separate the
    two. Its values may therefore be far from all residuals, as its standard deviations show. For
    this reason `systematic_m` and `scatter` come from a plain fit.
    """
    outlier = np.zeros(len(used), dtype=bool)
    outlier[used] = result.outlier
    basic = _without_exposure(names)
    design = np.column_stack([columns[name] for name in names])
    share, probability = _share_of_exposure(names, result)
    values = _plain_fit(data, design, used & ~outlier)
    weight = 1.0 / np.sqrt(data.errors.total)
    unit = (data.residual_m - design @ values) * weight
    rows = {name: column[used] * weight[used] for name, column in columns.items()}
    return Regression(
        terms=tuple(
            replace(term, alike=_alike(term.name, rows, [names[index] for index in basic], tangled))
            for term in _terms(names, result)
        ),
        tangled=tangled,
        count=int(np.count_nonzero(used & ~outlier)),
        used=used,
        outlier=outlier,
        scatter=float(np.sqrt(np.sum(unit[used & ~outlier] ** 2) / result.freedom)),
        correlation_s=result.correlation_s,
        exposure_share=share,
        exposure_probability=probability,
        systematic_m=design[:, basic] @ values[basic],
    )


def _alike(
    name: str, rows: Mapping[str, FloatArray], basic: Sequence[str], tangled: Sequence[str]
) -> tuple[str, ...]:
    """Return the quantities without a term whose effect looks like that of a term of exposure.

    Parameters
    ----------
    rows : mapping
        Weighted columns (m,) of all terms and quantities.
    basic : sequence of str
        Terms of the distance, which take up their share of every effect.
    """
    if name in basic:
        return ()
    basis = np.linalg.qr(np.column_stack([rows[other] for other in basic]))[0]

    def beyond_basic(column: FloatArray) -> FloatArray:
        return np.asarray(column - basis @ (basis.T @ column))

    own = beyond_basic(rows[name])
    others = {other: beyond_basic(rows[other]) for other in tangled}
    return tuple(
        other
        for other, column in others.items()
        if (own @ column) ** 2 > _ALIKE * (own @ own) * (column @ column)
    )


def _plain_fit(data: DistanceResiduals, design: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return the values (p,) of a weighted fit that takes all errors as independent."""
    weight = 1.0 / np.sqrt(data.errors.total[chosen])
    rows = design[chosen] * weight[:, None]
    size = np.linalg.norm(rows, axis=0)
    values = np.linalg.lstsq(rows / size, data.residual_m[chosen] * weight, rcond=None)[0]
    return np.asarray(values / size)


def _without_exposure(names: Sequence[str]) -> list[int]:
    return [index for index, name in enumerate(names) if index < 2 or name == _CURVATURE]


def _share_of_exposure(names: Sequence[str], result: RegressionFit) -> tuple[float, float | None]:
    others = _without_exposure(names)
    extra = len(names) - len(others)
    if not extra:
        return 0.0, None
    without = result.chi2_of(others)
    share = 1.0 - (result.chi2 / result.freedom) / (without / (result.freedom + extra))
    ratio = (without - result.chi2) / extra / (result.chi2 / result.freedom)
    return max(0.0, share), float(fdtrc(extra, result.freedom, max(0.0, ratio)))
