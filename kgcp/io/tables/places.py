"""Tables of placed targets: `places.parquet`, their residuals, and `places.csv`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.io.files.csv_text import DEGREE_DECIMALS, csv_text
from kgcp.io.tables.columns import (
    BOOLEAN,
    INTEGER,
    NUMBER,
    NUMBERS,
    TEXT,
    Column,
    Row,
    matrix_cell,
    row_of,
)
from kgcp.network.ground.target_places import PlacedTarget

_AXES = "xyz"
_METRE_DECIMALS = 9
_MOMENTS = ("x_px", "y_px", "s_xx_px2", "s_xy_px2", "s_yy_px2")


@dataclass(frozen=True, slots=True)
class PlaceResidual:
    """Residuals of one frame in the position of a target."""

    placed: PlacedTarget
    row: int


PLACE_COLUMNS: tuple[Column[PlacedTarget], ...] = (
    Column("target", TEXT, lambda placed: placed.target),
    Column("shape", TEXT, lambda placed: placed.shape.value),
    *Column[PlacedTarget].of_vector(_AXES, lambda placed: placed.position_map),
    *Column[PlacedTarget].of_vector([f"sd_{a}" for a in _AXES], lambda placed: placed.sds),
    *Column[PlacedTarget].of_vector([f"normal_{a}" for a in _AXES], lambda placed: placed.normal),
    Column("sd_normal_deg", NUMBER, lambda placed: placed.sd_normal_deg),
    Column("tilt_deg", NUMBER, lambda placed: placed.tilt_deg),
    Column("diameter_m", NUMBER, lambda placed: placed.diameter_m),
    Column("sd_diameter_m", NUMBER, lambda placed: placed.sd_diameter_m),
    Column("cov", NUMBERS, lambda placed: matrix_cell(placed.cov)),
    Column("common_cov", NUMBERS, lambda placed: matrix_cell(placed.common_cov)),
    *Column[PlacedTarget].of_vector(
        [f"alt_normal_{a}" for a in _AXES], lambda placed: placed.other_normal
    ),
    Column("ambiguity", NUMBER, lambda placed: placed.ambiguity),
    Column("frames", INTEGER, lambda placed: len(placed.frames)),
    Column("frames_used", INTEGER, lambda placed: int(np.count_nonzero(placed.is_used))),
    Column("variance_factor", NUMBER, lambda placed: placed.variance_factor),
    Column("worst_frame", TEXT, lambda placed: placed.worst_frame),
    *Column[PlacedTarget].of_vector(
        [f"residual_{a}_m" for a in _AXES], lambda placed: placed.check.residual_m
    ),
    *Column[PlacedTarget].of_sds(
        [f"sd_residual_{a}_m" for a in _AXES], lambda placed: placed.check.cov_m2
    ),
    Column("diameter_residual_m", NUMBER, lambda placed: placed.check.diameter_residual_m),
    Column("sd_diameter_residual_m", NUMBER, lambda placed: placed.check.sd_diameter_residual_m),
)


PLACE_RESIDUAL_COLUMNS: tuple[Column[PlaceResidual], ...] = (
    Column("target", TEXT, lambda residual: residual.placed.target),
    Column("frame", TEXT, lambda residual: residual.placed.frames[residual.row]),
    Column("used", BOOLEAN, lambda residual: bool(residual.placed.is_used[residual.row])),
    Column("chi2", NUMBER, lambda residual: float(residual.placed.chi2[residual.row])),
    *Column[PlaceResidual].of_vector(
        [f"residual_{name}" for name in _MOMENTS],
        lambda residual: residual.placed.residuals[residual.row],
    ),
)


def residual_rows(placed: Sequence[PlacedTarget]) -> Iterator[Row]:
    """Yield a row for each frame of each target."""
    for target in placed:
        for row in range(len(target.frames)):
            yield row_of(PLACE_RESIDUAL_COLUMNS, PlaceResidual(target, row))


def places_csv(placed: Sequence[PlacedTarget], *, is_geographic: bool) -> str:
    """Return places as CSV, in the columns of other programs' point lists.

    Parameters
    ----------
    is_geographic : bool
        Whether x and y are degrees, which need more decimals than metres.
    """
    normal_columns = [f"normal_{a}" for a in _AXES]
    columns = [
        "name",
        *_AXES,
        *(f"sd_{a}" for a in _AXES),
        "diameter_m",
        "sd_diameter_m",
        *normal_columns,
    ]
    rows = []
    for target in placed:
        x, y, z = target.position_map.tolist()
        xy_decimals = DEGREE_DECIMALS if is_geographic else _METRE_DECIMALS
        position = f"{x:.{xy_decimals}f}", f"{y:.{xy_decimals}f}", f"{z:.{_METRE_DECIMALS}f}"
        sds = (f"{value:.6f}" for value in target.sds[:3].tolist())
        size = (f"{target.diameter_m:.6f}", f"{target.sd_diameter_m:.6f}")
        normal = (f"{value:.7f}" for value in target.normal.tolist())
        rows.append([target.target, *position, *sds, *size, *normal])
    return csv_text(columns, rows)
