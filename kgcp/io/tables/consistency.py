"""The comparison of vehicle and camera as `consistency.json` and `consistency.parquet`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from kgcp.io.files.atomic import remove, write_bytes
from kgcp.io.tables.columns import BOOLEAN, TEXT, TIME, Column, row_of, time_cell
from kgcp.io.tables.parquet import write_table
from kgcp.quality.advice import advice, rms_m
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.consistency import Consistency, Discrepancy

_AXES = ("along", "across", "up")


CONSISTENCY_COLUMNS: tuple[Column[Discrepancy], ...] = (
    Column("frame", TEXT, lambda discrepancy: discrepancy.frame),
    Column("target", TEXT, lambda discrepancy: discrepancy.target),
    Column("time", TIME, lambda discrepancy: time_cell(discrepancy.time_s)),
    *Column[Discrepancy].of_vector(
        [f"{axis}_m" for axis in _AXES], lambda discrepancy: discrepancy.offset_m
    ),
    *Column[Discrepancy].of_sds(
        [f"sd_{axis}_m" for axis in _AXES], lambda discrepancy: discrepancy.cov_m2
    ),
    *Column[Discrepancy].of_vector(
        [f"residual_{axis}_m" for axis in _AXES], lambda discrepancy: discrepancy.residual_m
    ),
    Column("outlier", BOOLEAN, lambda discrepancy: discrepancy.is_outlier),
)


def write_consistency(
    folder: Path, consistency: Consistency, doubts: Sequence[Doubt], metadata: Mapping[str, str]
) -> tuple[Path, Path]:
    """Write both files; return their paths.

    Raises
    ------
    KgcpError
        If they cannot be written.
    """
    summary, table = _paths(folder)
    text = json.dumps(_summary(consistency, doubts), indent=2, ensure_ascii=False, allow_nan=False)
    write_bytes(summary, f"{text}\n".encode())
    rows = (row_of(CONSISTENCY_COLUMNS, discrepancy) for discrepancy in consistency.discrepancies)
    write_table(table, CONSISTENCY_COLUMNS, rows, metadata)
    return summary, table


def remove_consistency(folder: Path) -> None:
    """Remove both files of an earlier export, which do not describe the points written now."""
    for path in _paths(folder):
        remove(path)


def _paths(folder: Path) -> tuple[Path, Path]:
    return folder / "consistency.json", folder / "consistency.parquet"


def _summary(consistency: Consistency, doubts: Sequence[Doubt]) -> dict[str, object]:
    estimate = consistency.estimate
    return {
        "points": len(consistency.discrepancies),
        "outliers": sum(discrepancy.is_outlier for discrepancy in consistency.discrepancies),
        "rms_m": dict(zip(_AXES, rms_m(consistency), strict=True)),
        "corrections": [
            {**asdict(correction), "is_significant": correction.is_significant}
            for correction in estimate.corrections
        ],
        "chi2_before": estimate.chi2_before,
        "chi2_after": estimate.chi2_after,
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "correlation_s": consistency.correlation_s,
        "advice": advice(consistency, doubts),
        "doubts": [doubt.summary() for doubt in doubts],
    }
