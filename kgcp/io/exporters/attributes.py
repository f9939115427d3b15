"""What a map shows of a point: one flat row of attributes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kgcp.io.times import format_time
from kgcp.kgcps import Kgcp

ATTRIBUTES: Mapping[str, str] = {
    **dict.fromkeys(("id", "frame", "target", "time", "role"), "TEXT"),
    **dict.fromkeys(("x", "y", "z", "sd_x", "sd_y", "sd_z", "x_px", "y_px"), "DOUBLE"),
    **dict.fromkeys(("distance_m", "sd_distance_m"), "DOUBLE"),
}
"""Names and their types in SQL, in order."""


def attributes(point: Kgcp) -> dict[str, str | float | None]:
    """Return the attributes of a point; None where unknown."""
    sds = [None] * 3 if point.cov_m2 is None else np.sqrt(np.diag(point.cov_m2)).tolist()
    x, y, z = point.position_map.tolist()
    x_px, y_px = point.centre_px.tolist()
    return {
        "id": point.id,
        "frame": point.frame,
        "target": point.target,
        "time": None if point.time_s is None else format_time(point.time_s),
        "role": "check" if point.is_checkpoint else "control",
        "x": x,
        "y": y,
        "z": z,
        **dict(zip(("sd_x", "sd_y", "sd_z"), sds, strict=True)),
        "x_px": x_px,
        "y_px": y_px,
        "distance_m": point.distance_m,
        "sd_distance_m": point.sd_distance_m,
    }
