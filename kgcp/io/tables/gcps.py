"""KGCPs and comparisons as rows of `kgcps.parquet` and `bias.parquet`."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.gcp import Kgcp
from kgcp.io.tables.columns import Row, time_cell
from kgcp.quality.bias_study import Comparison, Exposure, edge_distances
from kgcp.settings import Method

_EXPOSURE = tuple(field.name for field in fields(Exposure))


def kgcp_row(point: Kgcp) -> Row:
    """Return the row of one KGCP."""
    return {
        "id": point.id,
        "frame": point.frame,
        "target": point.target,
        "time": time_cell(point.time_s),
        **dict(zip("xyz", point.position_map.tolist(), strict=True)),
        **_deviations(("sd_x", "sd_y", "sd_z"), point.cov_m2),
        "cov": _flat(point.cov_m2),
        "cov_common": _flat(point.cov_common_m2),
        "common_effects": _flat(point.common_m),
        "x_px": float(point.centre_px[0]),
        "y_px": float(point.centre_px[1]),
        **_deviations(("sd_x_px", "sd_y_px"), point.centre_cov_px2),
        "distance_m": point.distance_m,
        "sd_distance_m": point.sd_distance_m,
        "sd_common_distance_m": point.sd_common_distance_m,
        "role": "check" if point.is_checkpoint else "control",
        "flag": "" if point.flag is None else point.flag.value,
    }


def bias_row(measured: Comparison, method: Method) -> Row:
    """Return the row of one comparison that has a residual, measured by some method."""
    seen = measured.attempt.sighting
    edges = edge_distances(measured, method)
    return {
        "frame": measured.attempt.frame,
        "target": measured.attempt.target,
        "time": time_cell(measured.attempt.time_s),
        "distance_m": None if seen is None else seen.distance_m,
        "sd_distance_m": None if seen is None else seen.sd_distance_m,
        "one_edge_distance_m": None if edges is None else edges.one_m,
        "two_edge_distance_m": None if edges is None else edges.two_m,
        "reference_distance_m": measured.reference_distance_m,
        "sd_reference_distance_m": None if measured.sds is None else measured.sds.total_m,
        "residual_m": measured.residual_m,
        "residual_percent": measured.residual_percent,
        **{name: getattr(measured.attempt.exposure, name) for name in _EXPOSURE},
    }


def _flat(matrix: FloatArray | None) -> list[float] | None:
    return None if matrix is None else matrix.ravel().tolist()


def _deviations(names: tuple[str, ...], cov: FloatArray | None) -> dict[str, float | None]:
    if cov is None:
        return dict.fromkeys(names)
    return {name: float(sd) for name, sd in zip(names, np.sqrt(np.diag(cov)), strict=True)}
