"""Columns of `kgcps.parquet`, from KGCPs, and of `bias.parquet`, from comparisons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

from kgcp.georef.gcp import Gcp
from kgcp.georef.sighting import Exposure, Sighting
from kgcp.io.tables.columns import (
    NUMBER,
    NUMBERS,
    TEXT,
    TIME,
    Column,
    Row,
    matrix_cell,
    row_of,
    time_cell,
)
from kgcp.quality.bias_study import Comparison, EdgeDistances, edge_distances
from kgcp.settings import Method

GCP_COLUMNS: tuple[Column[Gcp], ...] = (
    Column("id", TEXT, lambda point: point.id),
    Column("frame", TEXT, lambda point: point.frame),
    Column("target", TEXT, lambda point: point.target),
    Column("time", TIME, lambda point: time_cell(point.time_s)),
    *Column[Gcp].of_vector("xyz", lambda point: point.position_map),
    *Column[Gcp].of_sds(("sd_x", "sd_y", "sd_z"), lambda point: point.cov_m2),
    Column("cov", NUMBERS, lambda point: matrix_cell(point.cov_m2)),
    Column("cov_common", NUMBERS, lambda point: matrix_cell(point.cov_common_m2)),
    Column("common_effects", NUMBERS, lambda point: matrix_cell(point.common_m)),
    *Column[Gcp].of_vector(("x_px", "y_px"), lambda point: point.centre_px),
    *Column[Gcp].of_sds(("sd_x_px", "sd_y_px"), lambda point: point.centre_cov_px2),
    Column("distance_m", NUMBER, lambda point: point.distance_m),
    Column("sd_distance_m", NUMBER, lambda point: point.sd_distance_m),
    Column("sd_common_distance_m", NUMBER, lambda point: point.sd_common_distance_m),
    Column("role", TEXT, lambda point: "check" if point.is_checkpoint else "control"),
    Column("flag", TEXT, lambda point: "" if point.flag is None else point.flag.value),
)


_Compared = tuple[Comparison, Method]  # and the method of its measurement
_Get = Callable[[_Compared], object]


def _comparison(get: Callable[[Comparison], object]) -> _Get:
    return lambda compared: get(compared[0])


def _sighting(get: Callable[[Sighting], object]) -> _Get:
    return _comparison(
        lambda comparison: comparison.attempt.sighting and get(comparison.attempt.sighting)
    )


def _edges(get: Callable[[EdgeDistances], float]) -> _Get:
    def of_comparison(compared: _Compared) -> float | None:
        edges = edge_distances(compared[0], compared[1])
        return None if edges is None else get(edges)

    return of_comparison


def _exposure(name: str) -> _Get:
    return _comparison(lambda comparison: getattr(comparison.attempt.exposure, name))


BIAS_COLUMNS: tuple[Column[_Compared], ...] = (
    Column("frame", TEXT, _comparison(lambda comparison: comparison.attempt.frame)),
    Column("target", TEXT, _comparison(lambda comparison: comparison.attempt.target)),
    Column("time", TIME, _comparison(lambda comparison: time_cell(comparison.attempt.time_s))),
    Column("distance_m", NUMBER, _sighting(lambda sighting: sighting.distance_m)),
    Column("sd_distance_m", NUMBER, _sighting(lambda sighting: sighting.sd_distance_m)),
    Column("one_edge_distance_m", NUMBER, _edges(lambda edges: edges.by_outer_edge_m)),
    Column("two_edge_distance_m", NUMBER, _edges(lambda edges: edges.by_both_edges_m)),
    Column(
        "reference_distance_m",
        NUMBER,
        _comparison(lambda comparison: comparison.reference_distance_m),
    ),
    Column(
        "sd_reference_distance_m",
        NUMBER,
        _comparison(lambda comparison: comparison.sds and comparison.sds.total_m),
    ),
    Column("residual_m", NUMBER, _comparison(lambda comparison: comparison.residual_m)),
    Column("residual_percent", NUMBER, _comparison(lambda comparison: comparison.residual_percent)),
    *(Column(field.name, NUMBER, _exposure(field.name)) for field in fields(Exposure)),
)


def gcp_row(point: Gcp) -> Row:
    """Return the row of one KGCP."""
    return row_of(GCP_COLUMNS, point)


def bias_row(comparison: Comparison, method: Method) -> Row:
    """Return the row of one comparison that has a residual.

    Parameters
    ----------
    method : Method
        How the distance was measured.
    """
    return row_of(BIAS_COLUMNS, (comparison, method))
