"""Candidates for the unknown CRS of coordinates whose place is roughly known."""

from __future__ import annotations

import math

from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError

from kgcp.georef.crs import WGS84_3D

# Largest distance of the vehicle from the frames' own positions. In a wrong zone it is larger.
_MAX_DISTANCE_M = 5000.0
_DEGREE_M = 111_000.0  # of a meridian
# datums of satellite positioning, preferred in this order
_SATELLITE_DATUMS = ("ETRS89", "WGS 84", "NAD83", "GDA2020", "JGD2011")


def utm_crs(longitude_deg: float, latitude_deg: float) -> str:
    """Return the UTM zone (WGS 84) of a place, for pyproj.

    The special zones of Norway and Svalbard are ignored: any zone near by will do.
    """
    zone = math.floor((longitude_deg + 180.0) / 6.0) % 60 + 1
    return f"EPSG:{(32600 if latitude_deg >= 0.0 else 32700) + zone}"


def is_geographic_place(x: float, y: float) -> bool:
    """Tell whether a map point can be longitude and latitude [deg]."""
    return abs(x) <= 180.0 and abs(y) <= 90.0


def crs_near(x: float, y: float, longitude_deg: float, latitude_deg: float) -> tuple[str, ...]:
    """Return the CRS that put a map point near a known place: WGS 84, or projected ones of EPSG.

    Parameters
    ----------
    x, y : float
        Longitude and latitude [deg], or easting and northing [m], of the point.
    longitude_deg, latitude_deg : float
        The place, WGS 84.

    Returns
    -------
    tuple of str
        Those with datums of satellite positioning first, each once.
    """
    east_deg = (x - longitude_deg) * math.cos(math.radians(latitude_deg))
    if math.hypot(east_deg, y - latitude_deg) * _DEGREE_M < _MAX_DISTANCE_M:
        return (WGS84_3D,)
    area = AreaOfInterest(longitude_deg, latitude_deg, longitude_deg, latitude_deg)
    infos = query_crs_info("EPSG", [PJType.PROJECTED_CRS], area, contains=True)
    near = []
    for info in infos:
        crs = f"EPSG:{info.code}"
        if _is_near(crs, (x, y), (longitude_deg, latitude_deg)):
            is_datum = [info.name.startswith(datum) for datum in _SATELLITE_DATUMS]
            # EPSG:3044 is EPSG:25832 with the northing first; kgcp puts the easting first in both
            is_northing_first = info.name.endswith("(N-E)") or " (zE-N)" in info.name
            rank = is_datum.index(True) if True in is_datum else len(is_datum)
            near.append((rank, is_northing_first, len(info.name), int(info.code), crs))
    return tuple(dict.fromkeys(crs for *_, crs in sorted(near)))


def _is_near(crs: str, xy: tuple[float, float], place: tuple[float, float]) -> bool:
    """Tell whether a point of a CRS is within 5 km of a place; datum shifts are neglected."""
    try:
        parsed = CRS.from_user_input(crs)
        geodetic = parsed.geodetic_crs
        if geodetic is None:
            return False
        x, y = Transformer.from_crs(geodetic, parsed, always_xy=True).transform(*place)
    except ProjError:
        return False
    factor = parsed.axis_info[0].unit_conversion_factor
    return math.hypot(x - xy[0], y - xy[1]) * factor < _MAX_DISTANCE_M
