"""Plain CSV: all that kgcp knows about every point, one line each."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping

from kgcp.geometry.arrays import FloatArray
from kgcp.io.exporters.points import METRE_DECIMALS, MapPoints, decimals, deviations, pixel, upper
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
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for point in points.kgcps:
        writer.writerow(
            (
                *(point.id, point.frame, point.target),
                "" if point.time_s is None else format_time(point.time_s),
                *points.xyz(point.position_map),
                *_covariance(point.cov_m2, 3),
                *pixel(point),
                *_covariance(point.centre_cov_px2, 2),
                decimals(point.distance_m, METRE_DECIMALS),
                _text(point.sd_distance_m),
                _text(point.sd_common_distance_m),
                *_covariance(point.cov_common_m2, 3),
                "check" if point.is_checkpoint else "control",
                "" if point.flag is None else point.flag.value,
                points.crs,
            )
        )
    return {"kgcps.csv": stream.getvalue()}


def _covariance(cov: FloatArray | None, size: int) -> tuple[str, ...]:
    """Return deviations, then the covariances above the diagonal, row by row."""
    if cov is None:
        return ("",) * (size * (size + 1) // 2)
    values = (*deviations(cov), *upper(cov, 1))
    return tuple(_text(float(value)) for value in values)


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
