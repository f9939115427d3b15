"""Plain CSV: all that kgcp knows about every point, one line each."""

from __future__ import annotations

from collections.abc import Mapping

from kgcp.io.exporters.points import METRE_DECIMALS, MapPoints, covariance_cells, decimals, pixel
from kgcp.io.files.csv_text import csv_text
from kgcp.io.files.time_text import format_time

COLUMNS = (
    *("id", "frame", "target", "time", "x", "y", "z", "sd_x", "sd_y", "sd_z"),
    *("cov_xy", "cov_xz", "cov_yz", "x_px", "y_px", "sd_x_px", "sd_y_px", "cov_xy_px2"),
    *("distance_m", "sd_distance_m", "sd_common_distance_m"),
    *("sd_common_x", "sd_common_y", "sd_common_z"),
    *("cov_common_xy", "cov_common_xz", "cov_common_yz", "role", "flag", "crs"),
)
"""x is easting or longitude, y northing or latitude, z height, in `crs`; deviations in metres and
covariances in m² along these axes; (0, 0) px is the centre of the top-left pixel."""


def files(points: MapPoints) -> Mapping[str, str]:
    """Return `kgcps.csv`."""
    rows = [
        (
            *(point.id, point.frame, point.target),
            "" if point.time_s is None else format_time(point.time_s),
            *points.xyz(point.position_map),
            *covariance_cells(point.cov_m2, 3, 6),
            *pixel(point),
            *covariance_cells(point.centre_cov_px2, 2, 6),
            decimals(point.distance_m, METRE_DECIMALS),
            _text(point.sd_distance_m),
            _text(point.sd_common_distance_m),
            *covariance_cells(point.cov_common_m2, 3, 6),
            "check" if point.is_checkpoint else "control",
            "" if point.flag is None else point.flag.value,
            points.crs,
        )
        for point in points.gcps
    ]
    return {"kgcps.csv": csv_text(COLUMNS, rows)}


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
