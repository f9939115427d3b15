"""From the coordinates of a trajectory's file to those of the flight: points and directions."""

from __future__ import annotations

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import FARTHEST, MapFrame, best_transformer, geographic_of, parse_crs

VEHICLE_CRS = "flight.toml: [vehicle] crs"
_STEP_M, _STEP_DEG = 10.0, 1e-4  # curvature cancels in the central difference


def convert_positions(file: str, position: FloatArray, source: str, target: str) -> FloatArray:
    """Bring positions (n, 3) from one CRS to another by PROJ's best operation.

    x is easting or longitude and y northing or latitude on both sides.

    Parameters
    ----------
    file : str
        Where the positions come from, for messages.
    position : (n, 3) array
    source, target : str
        CRS, for pyproj.

    Raises
    ------
    KgcpError
        If no operation is known, its grid is not installed, or a point is out of its domain or
        far from the Earth's surface.
    """
    transformer = best_transformer(
        parse_crs(source, VEHICLE_CRS),
        parse_crs(target),
        f"{file}: the way of its positions from {source!r} to the flight's crs {target!r}",
    )
    converted = np.column_stack(transformer.transform(*position.T))
    found = np.isfinite(converted).all(axis=1)
    if not parse_crs(target).is_geocentric:
        found &= np.abs(converted[:, 2]) < FARTHEST
    lost = np.flatnonzero(~found)
    if lost.size:
        where = ", ".join(f"{value:.10g}" for value in position[lost[0]])
        raise KgcpError(
            f"{file}: the point ({where}) of epoch {lost[0] + 1} has no place in {target!r};"
            f" correct the file, or [vehicle] crs in flight.toml, which is {source!r} now"
        )
    return converted


def map_axes_ecef(crs: str, position: FloatArray) -> FloatArray:
    """Return the axes x, y, z of a CRS at positions (n, 3), as columns in ECEF, (n, 3, 3).

    Orthonormal: z is the ellipsoid's normal, y the map's y made square to it. Geocentric axes are
    those of ECEF.
    """
    parsed = parse_crs(crs, VEHICLE_CRS)
    if parsed.is_geocentric:
        return np.broadcast_to(np.eye(3), (len(position), 3, 3))
    frame = MapFrame.at(crs, position[0], VEHICLE_CRS)
    step = np.array([0.0, _STEP_DEG if parsed.is_geographic else _STEP_M, 0.0])
    up = frame.level_rotations(frame.enu_from_map(position))[:, :, 2]
    along_y = frame.enu_from_map(position + step) - frame.enu_from_map(position - step)
    x = np.cross(along_y, up)
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    axes: FloatArray = frame.ecef_from_enu @ np.stack((x, np.cross(up, x), up), axis=-1)
    return axes


def level_axes_ecef(crs: str, position: FloatArray) -> FloatArray:
    """Return east, north, up at positions (n, 3) of a CRS, as columns in ECEF, (n, 3, 3)."""
    parsed = parse_crs(crs, VEHICLE_CRS)
    if parsed.is_geocentric:
        frame = MapFrame.at(geographic_of(parsed), np.zeros(3), VEHICLE_CRS)
        enu = (position - frame.origin_ecef_m) @ frame.ecef_from_enu
    else:
        frame = MapFrame.at(crs, position[0], VEHICLE_CRS)
        enu = frame.enu_from_map(position)
    axes: FloatArray = frame.ecef_from_enu @ frame.level_rotations(enu)
    return axes


def turn_covariances(
    cov_m2: FloatArray, old_axes_ecef: FloatArray, new_axes_ecef: FloatArray
) -> FloatArray:
    """Bring covariances (n, 3, 3) from one set of axes (n, 3, 3) to another."""
    turn = np.swapaxes(new_axes_ecef, -1, -2) @ old_axes_ecef
    turned: FloatArray = turn @ cov_m2 @ np.swapaxes(turn, -1, -2)
    return turned
