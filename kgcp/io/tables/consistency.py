"""The comparison of vehicle and camera as `consistency.json` and `consistency.parquet`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from kgcp.io.files.atomic import write_bytes
from kgcp.io.tables.columns import CONSISTENCY_COLUMNS, Row, time_cell
from kgcp.io.tables.parquet import write_table
from kgcp.quality.advice import advice, rms_m
from kgcp.quality.consistency import Consistency, Discrepancy

_AXES = ("along", "across", "up")


def write_consistency(
    folder: Path, found: Consistency, metadata: Mapping[str, str]
) -> tuple[Path, Path]:
    """Write both files; return their paths.

    Raises
    ------
    KgcpError
        If they cannot be written.
    """
    summary, table = folder / "consistency.json", folder / "consistency.parquet"
    text = json.dumps(_summary(found), indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(summary, f"{text}\n".encode())
    write_table(table, CONSISTENCY_COLUMNS, map(_row, found.discrepancies), metadata)
    return summary, table


def _summary(found: Consistency) -> dict[str, object]:
    estimate = found.estimate
    return {
        "points": len(found.discrepancies),
        "outliers": sum(one.is_outlier for one in found.discrepancies),
        "rms_m": dict(zip(_AXES, rms_m(found), strict=True)),
        "corrections": [
            {**asdict(one), "is_significant": one.is_significant} for one in estimate.corrections
        ],
        "chi2_before": estimate.chi2_before,
        "chi2_after": estimate.chi2_after,
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "correlation_s": found.correlation_s,
        "advice": advice(found),
    }


def _row(one: Discrepancy) -> Row:
    deviations = np.sqrt(np.diag(one.cov_m2)).tolist()
    return {
        "frame": one.frame,
        "target": one.target,
        "time": time_cell(one.time_s),
        **_by_axis("{}_m", one.offset_m.tolist()),
        **_by_axis("sd_{}_m", deviations),
        **_by_axis("residual_{}_m", one.residual_m.tolist()),
        "outlier": one.is_outlier,
    }


def _by_axis(pattern: str, values: list[float]) -> Row:
    return {pattern.format(axis): value for axis, value in zip(_AXES, values, strict=True)}
