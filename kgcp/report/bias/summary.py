"""`bias_summary.json`: every number of the report for machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

from kgcp.quality.bias_causes import Regression
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.statistics import Slope
from kgcp.report.bias.numbers import BiasNumbers, RangeRow
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.bias.verdict import LIMITS, Verdict
from kgcp.report.bias.wording import meaning_of

Json = dict[str, object]


def summary_of(
    numbers: BiasNumbers,
    verdict: Verdict,
    doubts: Sequence[Doubt],
    reexposed: Sequence[Reexposed],
) -> Json:
    """Return everything that `bias_summary.json` holds."""
    frames, regression, edges = numbers.frames, numbers.regression, numbers.edges
    summary = {
        "verdict": verdict.grade.name.lower(),
        "findings": [
            {"grade": finding.grade.name.lower(), "text": finding.text}
            for finding in verdict.findings
        ],
        "doubts": [doubt.summary() for doubt in doubts],
        "limits": asdict(LIMITS),
        "compared": numbers.total.percent.count,
        "residual_percent": asdict(numbers.total.percent),
        "residual_m": asdict(numbers.total.metres),
        "biased": [row.label for row in numbers.biased],
        "ranges": [_range(row) for row in (*numbers.bins, *numbers.halves, numbers.total)],
        "sd_reference_m": numbers.sd_reference_m,
        "standardised": None if numbers.standardised is None else asdict(numbers.standardised),
        "regression": _regression(regression),
        "influences": {
            influence.quantity.name: {
                "count": len(influence.values),
                "per": influence.quantity.per,
                "residual_percent": _slope(influence.residual),
                "edge_shift_px": _slope(influence.edge_shift),
            }
            for influence in numbers.influences
        },
        "edges": None
        if edges is None
        else {
            "one_edge_percent": asdict(edges.outer_edge_percent),
            "two_edges_percent": asdict(edges.both_edges_percent),
            "one_edge_regression": _regression(edges.regression),
        },
        "detected": numbers.detected,
        "frames_with_target": numbers.expected_visible,
        "rates_by_distance_m": [{**asdict(rate), "rate": rate.rate} for rate in numbers.rates],
        "rates_by_radius_px": [
            {**asdict(rate), "rate": rate.rate} for rate in numbers.radius_rates
        ],
        "reexposure": [
            {"frame": frames[again.row], **{k: v for k, v in asdict(again).items() if k != "row"}}
            for again in reexposed
        ],
        "outliers": []
        if regression is None
        else [frames[row] for row in regression.outlier.nonzero()[0].tolist()],
        "misplaced": list(numbers.misplaced),
        "left_out": dict(numbers.left_out),
        "attitudes_agree": numbers.attitudes_agree,
    }
    return {key: finite(item) for key, item in summary.items()}


def _range(row: RangeRow) -> Json:
    return {
        "range": row.label,
        "residual_percent": asdict(row.percent),
        "residual_m": asdict(row.metres),
        "sd_reference_percent": row.sd_reference_percent,
        "sd_motion_percent": row.sd_motion_percent,
    }


def _regression(regression: Regression | None) -> Json | None:
    if regression is None:
        return None
    return {
        "count": regression.count,
        "outliers": int(regression.outlier.sum()),
        "scatter": regression.scatter,
        "correlation_s": regression.correlation_s,
        "exposure_share": regression.exposure_share,
        "exposure_probability": regression.exposure_probability,
        "tangled": list(regression.tangled),
        "terms": {
            term.name: {
                "value": term.value,
                "sd": term.sd,
                "probability": term.probability,
                "significant": term.is_significant,
                "alike": list(term.alike),
                "text": meaning_of(term),
            }
            for term in regression.terms
        },
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


def finite(value: object) -> object:
    """Return a tree of numbers with null for those that are not finite."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
