"""Points in a Cartesian frame, for packages that know no map: east, north, up of one origin.

Metres on a grid are not metres: a distance of 80 m on the ground is 32 mm shorter in the middle of
a UTM zone, while heights keep their scale. Packages that adjust in plain Cartesian coordinates
therefore get a frame that is tangent to the CRS's ellipsoid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pyproj.enums import WktVersion

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.local_frame import LocalFrame
from kgcp.io.exporters.points import MapPoints

_ROUND_MAP, _ROUND_DEGREES, _ROUND_HEIGHT = 100.0, 0.001, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class LocalPoints:
    """The points of a `MapPoints` in its local frame."""

    local_frame: LocalFrame
    origin_map: FloatArray  # (3,): the frame's origin in the map
    position_m: FloatArray  # (n, 3): east, north, up of the points, in their order [m]
    enu_from_map: FloatArray  # (n, 3, 3): from the map's axes at each point to east, north, up

    def cov_m2(self, index: int, cov_map: FloatArray) -> FloatArray:
        """Turn the covariance (3, 3) of a point from the map's axes to east, north, up."""
        axes = self.enu_from_map[index]
        turned: FloatArray = axes @ cov_map @ axes.T
        return turned


@lru_cache(maxsize=1)
def local_points(points: MapPoints) -> LocalPoints:
    """Place the points in a frame over the first of them, rounded to a short origin.

    Raises
    ------
    KgcpError
        As `LocalFrame.at`.
    """
    step = _ROUND_DEGREES if points.parsed_crs.is_geographic else _ROUND_MAP
    steps = np.array([step, step, _ROUND_HEIGHT])
    positions = np.array([point.position_map for point in points.gcps])
    origin = np.round(positions[0] / steps) * steps
    local_frame = LocalFrame.at(points.crs, origin)
    position_m = local_frame.enu_from_map(positions)
    return LocalPoints(local_frame, origin, position_m, local_frame.grid_rotation(position_m))


def local_cameras(points: MapPoints) -> tuple[FloatArray, FloatArray]:
    """Return the priors' positions (n, 3) [m] and map axes (n, 3, 3) there, in the local frame."""
    local_frame = local_points(points).local_frame
    positions = np.array([prior.position_map for prior in points.priors]).reshape(-1, 3)
    position_m = local_frame.enu_from_map(positions)
    return position_m, local_frame.grid_rotation(position_m)


@dataclass(frozen=True, slots=True)
class Origin:
    """The local frame's origin as PROJ takes it."""

    # in degrees and metres above the ellipsoid
    longitude: str
    latitude: str
    height: str
    ellipsoid: str  # PROJ's parameters of its size


def origin_of(points: MapPoints) -> Origin:
    """Return the origin of the points' local frame."""
    local_frame = local_points(points).local_frame
    longitude, latitude, height = local_frame.geodetic_deg(np.zeros((1, 3)))[0]
    a, b = local_frame.semi_axes_m
    return Origin(f"{longitude:.13f}", f"{latitude:.13f}", f"{height:.7f}", f"+a={a!r} +b={b!r}")


def describe_frame(points: MapPoints) -> str:
    """Return lines for a HOWTO that say what the frame is and how to get other points into it."""
    crs = points.parsed_crs
    x, y, z = points.xyz(local_points(points).origin_map)
    origin = origin_of(points)
    name = crs.name or crs.to_wkt(WktVersion.WKT2_2019)
    return f"""\
Coordinates are metres east, north and up of an origin, tangent to the ellipsoid of
{points.crs} ({name}), not on its grid, where distances are not true.
Origin in {points.crs}: x {x}  y {y}  z {z}
To bring other points (longitude, latitude in degrees, ellipsoidal height of the same
datum) into this frame, and with cct -I back again:
  cct -d 6 +proj=pipeline +step +proj=cart {origin.ellipsoid} \\
    +step +proj=topocentric {origin.ellipsoid} \\
    +lon_0={origin.longitude} +lat_0={origin.latitude} +h_0={origin.height}
"""
