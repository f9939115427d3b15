"""From the map to longitude, latitude and height in WGS 84, for formats that know nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.mapchange import best_transformer
from kgcp.mapframe import WGS84_3D, parse_crs


def wgs84_from_map(crs: str, positions: Sequence[FloatArray], where: str) -> FloatArray:
    """Bring map points (n, 3) to longitude, latitude [deg] and ellipsoidal height [m] (n, 3).

    Through the best transformation that PROJ has, datum and geoid included.

    Raises
    ------
    KgcpError
        If none is known, or its grid is not installed; `where` is the format's name.
    """
    if not positions:
        return np.empty((0, 3))
    to_wgs84 = best_transformer(
        parse_crs(crs), parse_crs(WGS84_3D), f"{where}: the way from {crs!r} to WGS 84"
    )
    x, y, z = np.array(positions).T
    return np.column_stack(to_wgs84.transform(x, y, z, errcheck=True))
