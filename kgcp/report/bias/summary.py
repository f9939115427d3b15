"""`bias_summary.json`: every number of the report for machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

from kgcp.quality.bias_causes import Regression
from kgcp.quality.statistics import Slope
from kgcp.report.bias.numbers import BiasNumbers, EdgeNumbers, Influence
from kgcp.report.bias.ranges import DetectionRate, RangeRow
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.bias.verdict import LIMITS, Verdict
from kgcp.report.bias.wording import meaning_of

Json = dict[str, object]


def summary_of(
    numbers: BiasNumbers, verdict: Verdict, reexposed: Sequence[Reexposed], frames: Sequence[str]
) -> Json:
    """Return everything that `bias_summary.json` holds; `frames` are those of the rows."""
    return {
        "verdict": verdict.grade.name.lower(),
        "findings": [
            {"grade": one.grade.name.lower(), "text": one.text} for one in verdict.findings
        ],
        "limits": asdict(LIMITS),
        "compared": numbers.total.percent.count,
        "residual_percent": asdict(numbers.total.percent),
        "residual_m": asdict(numbers.total.metres),
        "biased": [row.label for row in numbers.biased],
        "ranges": [_range(row) for row in (*numbers.bins, *numbers.halves, numbers.total)],
        "sd_reference_m": numbers.sd_reference_m,
        "standardised": None if numbers.standardised is None else asdict(numbers.standardised),
        "regression": None if numbers.regression is None else _regression(numbers.regression),
        "influences": {one.quantity.name: _influence(one) for one in numbers.influences},
        "edges": None if numbers.edges is None else _edges(numbers.edges),
        "detected": numbers.detected,
        "frames_with_target": numbers.chances,
        "rates_by_distance_m": [_rate(rate) for rate in numbers.rates],
        "rates_by_radius_px": [_rate(rate) for rate in numbers.radius_rates],
        "reexposure": [_again(one, frames) for one in reexposed],
        "outliers": _outliers(numbers, frames),
        "astray": list(numbers.astray),
        "left_out": dict(numbers.left_out),
        "attitudes_agree": numbers.attitudes_agree,
    }


def _range(row: RangeRow) -> Json:
    return {
        "range": row.label,
        "residual_percent": asdict(row.percent),
        "residual_m": asdict(row.metres),
        "sd_reference_percent": row.sd_reference_percent,
    }


def _rate(rate: DetectionRate) -> Json:
    return {**asdict(rate), "rate": rate.rate}


def _regression(found: Regression) -> Json:
    return {
        "count": found.count,
        "outliers": int(found.outlier.sum()),
        "scatter": found.scatter,
        "correlation_s": found.correlation_s,
        "exposure_share": found.exposure_share,
        "exposure_probability": found.exposure_probability,
        "tangled": list(found.tangled),
        "terms": {
            term.name: {
                "value": term.value,
                "sd": term.sd,
                "probability": term.probability,
                "significant": term.is_significant,
                "text": meaning_of(term),
            }
            for term in found.terms
        },
    }


def _influence(one: Influence) -> Json:
    return {
        "count": len(one.values),
        "per": one.quantity.per,
        "residual_percent": _slope(one.residual),
        "edge_shift_px": _slope(one.edge_shift),
    }


def _slope(slope: Slope | None) -> Json | None:
    if slope is None:
        return None
    return {
        "slope": slope.value,
        "sd": slope.sd_value,
        "probability": slope.probability,
        "share": slope.share,
    }


def _edges(edges: EdgeNumbers) -> Json:
    return {
        "one_edge_percent": asdict(edges.one_percent),
        "two_edges_percent": asdict(edges.two_percent),
        "one_edge_regression": None if edges.regression is None else _regression(edges.regression),
    }


def _again(one: Reexposed, frames: Sequence[str]) -> Json:
    return {"frame": frames[one.row], **{k: v for k, v in asdict(one).items() if k != "row"}}


def _outliers(numbers: BiasNumbers, frames: Sequence[str]) -> list[str]:
    if numbers.regression is None:
        return []
    return [frames[row] for row in numbers.regression.outlier.nonzero()[0].tolist()]


def finite(value: object) -> object:
    """Return a tree of numbers in which what is not a finite number is null."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
