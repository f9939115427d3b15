"""What residuals of distances are made of: a scale, an offset, and what exposure does to edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.quality.exposure_effects import QUANTITIES, DistanceResiduals, varies
from kgcp.quality.robust_gls import RegressionFit, fit, separable, two_sided

SIGNIFICANT = 0.01
"""Largest probability, corrected for the number of terms, of what is called significant."""

MIN_COUNT = 6
_PER_TERM = 4  # observations that every term of exposure must have
_KNOWN_SHARE = 0.9  # of the frames that must have a quantity
_MAX_INFLATION = 25.0  # of a term's variance by the others: a standard deviation five times larger
_DISTANCE_LIKE = 1000.0  # the same of what grows with distance alone, and is always looked for
_CURVED = "edge_curvature_px2"


@dataclass(frozen=True, slots=True)
class Term:
    """One cause, as far as residuals show it."""

    name: str  # `scale`, `offset_m`, `edge_curvature_px2`, or a column of the exposure
    # estimate and standard deviation: of `scale` relative, of `offset_m` in metres, of
    # `edge_curvature_px2` displacement of the edge times its radius [px²], of the others
    # displacement of the edge in pixels per unit
    value: float
    sd: float
    # of a value as large by chance (Student's t, both sides), by Holm's correction for the number
    # of terms
    probability: float

    @property
    def is_significant(self) -> bool:
        """Whether it is more than chance."""
        return self.probability < SIGNIFICANT


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Residual = scale · distance + offset + what displaced edges do."""

    terms: tuple[Term, ...]  # `scale` first
    # quantities that vary, but so much like others that they cannot be told from them
    tangled: tuple[str, ...]
    count: int  # residuals that took part
    # (n,): rows that have all quantities; those of them that fit nothing and were left out
    used: BoolArray
    outlier: BoolArray
    # of the residuals about a plain fit, over their stated deviations; 1 where these are true
    scatter: float
    correlation_s: float  # as in `RegressionFit`
    # of the variance that scale and offset leave, what the terms of exposure explain, corrected for
    # their number; 0 without any
    exposure_share: float
    # of as large a share by chance (F test); None without such terms
    exposure_probability: float | None
    systematic_m: FloatArray  # (n,): what a plain fit finds, without the terms of exposure [m]

    @property
    def exposure_terms(self) -> tuple[Term, ...]:
        """The terms of exposure."""
        names = {quantity.name for quantity in QUANTITIES}
        return tuple(term for term in self.terms if term.name in names)

    @property
    def is_exposure_significant(self) -> bool:
        """Whether any effect of exposure is more than chance."""
        return any(term.is_significant for term in self.exposure_terms)


def regress(data: DistanceResiduals) -> Regression | None:
    """Separate the causes of residuals; None for too few, or for distances that do not vary.

    Edges displaced by ε px change a distance by D ε / R, R being the ring's radius in px: which
    with R ∝ 1/D grows with the square of the distance. So each exposure quantity x has the column
    (x − mean) D / R, and δ, which is a displacement itself, δ D / R. Blur displaces curved edges
    by σ² / 2R, so that D / R² is looked for last, and kept where it is significant.
    """
    if len(data.residual_m) < MIN_COUNT or not varies(data.residual_m):
        return None
    columns, used = _columns(data)
    weight = 1.0 / np.sqrt(data.errors.total)
    names = _names_told_apart(columns, used, weight, int(np.count_nonzero(used)) // _PER_TERM)
    if "offset_m" not in names:
        return None
    tangled = tuple(name for name in columns if name not in names)
    result = _fit(data, columns, names, used)
    curved = {**columns, _CURVED: data.distance_m / data.radius_px**2}
    more = _names_told_apart(curved, used, weight, len(used))
    if set(more) >= {*names, _CURVED} and used.sum() > _PER_TERM * (len(names) + 1):
        other = _fit(data, curved, [*names, _CURVED], used)
        if _terms([*names, _CURVED], other)[-1].is_significant:
            names, columns, result = [*names, _CURVED], curved, other
    return _regression(data, columns, names, tangled, used, result)


def _columns(data: DistanceResiduals) -> tuple[dict[str, FloatArray], BoolArray]:
    """Return the columns of all terms that vary, and the rows that have all of them."""
    per_px = data.distance_m / data.radius_px
    columns = {"scale": data.distance_m, "offset_m": np.ones_like(data.distance_m)}
    used = np.ones(len(data.distance_m), dtype=bool)
    for quantity in QUANTITIES:
        values = quantity.measure(data.exposure[quantity.name])
        present = np.isfinite(values)
        if present.mean() < _KNOWN_SHARE or not varies(values[present]):
            continue
        used &= present
        zero = 0.0 if quantity.is_absolute else float(np.mean(values[present]))
        columns[quantity.name] = (values - zero) * per_px
    return columns, used


def _names_told_apart(
    columns: dict[str, FloatArray], used: BoolArray, weight: FloatArray, most: int
) -> list[str]:
    """Return the names of the terms that can be told apart, at most so many."""
    rows = np.column_stack(list(columns.values()))[used] * weight[used, None]
    names = list(columns)
    limits = [_DISTANCE_LIKE if name in {"offset_m", _CURVED} else _MAX_INFLATION for name in names]
    active, _ = separable(rows.T @ rows, np.flatnonzero(rows.any(axis=0)).tolist(), limits)
    return [names[index] for index in active[: max(2, most)]]


def _fit(
    data: DistanceResiduals, columns: dict[str, FloatArray], names: Sequence[str], used: BoolArray
) -> RegressionFit:
    design = np.column_stack([columns[name] for name in names])[used]
    return fit(design, data.residual_m[used], data.errors.kept(used))


def _terms(names: Sequence[str], result: RegressionFit) -> tuple[Term, ...]:
    p_values = [
        two_sided(float(value / sd), result.freedom)
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
    """Return a fit by its terms, with what of it they and exposure explain.

    Errors that last longer than the flight are an offset themselves, and the fit leaves open which
    is which: its values may lie beside all residuals, within standard deviations that say so. What
    residuals have in common, and how they scatter about it, is therefore that of a plain fit.
    """
    outlier = np.zeros(len(used), dtype=bool)
    outlier[used] = result.outlier
    basic = _without_exposure(names)
    design = np.column_stack([columns[name] for name in names])
    share, probability = _share_of_exposure(names, result)
    values = _plain_fit(data, design, used & ~outlier)
    unit = (data.residual_m - design @ values) / np.sqrt(data.errors.total)
    return Regression(
        terms=_terms(names, result),
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


def _plain_fit(data: DistanceResiduals, design: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return the values (p,) by weights alone, as if no error lasted."""
    weight = 1.0 / np.sqrt(data.errors.total[chosen])
    rows = design[chosen] * weight[:, None]
    size = np.linalg.norm(rows, axis=0)
    values = np.linalg.lstsq(rows / size, data.residual_m[chosen] * weight, rcond=None)[0]
    return np.asarray(values / size)


def _without_exposure(names: Sequence[str]) -> list[int]:
    return [index for index, name in enumerate(names) if index < 2 or name == _CURVED]


def _share_of_exposure(names: Sequence[str], result: RegressionFit) -> tuple[float, float | None]:
    others = _without_exposure(names)
    extra = len(names) - len(others)
    if not extra:
        return 0.0, None
    without = result.chi2_of(others)
    share = 1.0 - (result.chi2 / result.freedom) / (without / (result.freedom + extra))
    ratio = (without - result.chi2) / extra / (result.chi2 / result.freedom)
    return max(0.0, share), float(fdtrc(extra, result.freedom, max(0.0, ratio)))
