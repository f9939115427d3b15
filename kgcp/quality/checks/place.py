"""Check of coordinates against their CRS's area of use, and what they seem to be if outside."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import (
    AreaOfUse,
    area_of_use,
    grid_scale,
    is_geographic,
    longitude_latitude,
)
from kgcp.georef.crs_guess import utm_crs
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild

# Largest distance from the area. Zones are also used beside it: EPSG:25832 in all of Bavaria and
# Denmark.
_MAX_OUTSIDE_DEG = 3.5
_MAX_STRETCH = 0.01  # of lengths on the map
_NEAR_DEG = 1.0  # largest distance from the area of another reading that fits
_MAX_DEG = np.array([180.0, 90.0])  # longitude, latitude
_MAX_RAD = np.array([np.pi, 0.5 * np.pi])
_MAX_NAME_LENGTH = 75
_ZONE_FACTOR = 1e6  # zone numbers may stand before eastings of six digits: 32 689586


def check_place(crs: str, position_map: FloatArray, where: str) -> Iterator[Doubt]:
    """Compare map positions (n, 2 or 3) with the area in which their CRS is used.

    Parameters
    ----------
    where : str
        Subject of the sentence: "the trajectory".
    """
    area = area_of_use(crs)
    is_angular = is_geographic(crs)
    xy = (median_place if is_angular else _median)(position_map[:, :2])
    outside = _outside(area, crs, xy)
    may_be_radians = is_angular and bool(np.all(np.abs(xy) <= _MAX_RAD))
    if outside <= _MAX_OUTSIDE_DEG and not may_be_radians:
        return
    x, y = xy.tolist()
    longitude, latitude = longitude_latitude(crs, xy[None])[0].tolist()
    figures = {"x": x, "y": y, "longitude_deg": longitude, "latitude_deg": latitude}
    sentence = f"{where}: x = {x:.9g}, y = {y:.9g} is {_spot(longitude, latitude)}"
    if area is not None and not area.is_world:
        sentence += f", {outside:.0f}° outside the area of {crs} ({_short(area.name)})"
    guess = (_angular_guess if is_angular else _projected_guess)(area, crs, xy)
    if guess is None:
        remedy = "give the CRS of the coordinates, x = easting or longitude first"
        yield grave(Cause.CRS, sentence, remedy, figures)
    else:
        code, words, remedy = guess
        yield grave(code, f"{sentence}: {words}", remedy, figures)


def check_grid_scale(crs: str, position_map: FloatArray) -> Iterator[Doubt]:
    """Yield the doubt about a CRS whose map is much larger or smaller than the ground.

    Adjustments take coordinates for metres in all directions. Zones of a country's own grid are
    true to 0.3 %, and heights are never stretched.

    Parameters
    ----------
    position_map : (n, 2 or 3) array
        Map positions within the area of the CRS.
    """
    place = longitude_latitude(crs, _median(position_map[:, :2])[None])[0]
    if not np.isfinite(place).all():
        return
    remedy = (
        f"give the region's own projection as crs in flight.toml, for example"
        f" {utm_crs(*place.tolist())}; a trajectory with longitude and latitude is transformed,"
        " other coordinates must be exported anew"
    )
    yield from _doubts_of_scale(crs, place, remedy)


def check_export_crs(crs: str, position_map: FloatArray) -> Iterator[Doubt]:
    """Yield the doubt about a CRS that points are transformed into.

    Parameters
    ----------
    position_map : (n, 2 or 3) array
        Places of the points in that CRS.
    """
    xy = (median_place if is_geographic(crs) else _median)(position_map[:, :2])
    place = longitude_latitude(crs, xy[None])[0]
    if not np.isfinite(place).all():
        return
    remedy = f"name a CRS of this region, for example --crs {utm_crs(*place.tolist())}"
    area = area_of_use(crs)
    outside = _outside(area, crs, xy)
    if area is None or outside <= _MAX_OUTSIDE_DEG:
        yield from _doubts_of_scale(crs, place, remedy)
        return
    yield mild(
        Cause.CRS,
        f"the points are {_spot(*place.tolist())}, {outside:.0f}° outside the area of {crs}"
        f" ({_short(area.name)})",
        remedy,
        {"outside_deg": outside},
    )


def _doubts_of_scale(crs: str, place_deg: FloatArray, remedy: str) -> Iterator[Doubt]:
    scale = grid_scale(crs, *place_deg.tolist())
    if abs(scale - 1.0) <= _MAX_STRETCH:
        return
    change = "stretches" if scale > 1.0 else "shrinks"
    yield mild(
        Cause.GRID_SCALE,
        f"{crs} {change} horizontal lengths by {100.0 * abs(scale - 1.0):.2g} % here, but not"
        " heights: adjustments that take its coordinates for metres distort the scene",
        remedy,
        {"scale": scale},
    )


def median_place(lonlat_deg: FloatArray) -> FloatArray:
    """Return the median (2,) of places (n, 2), longitude first, also across the antimeridian."""
    first = lonlat_deg[0]
    return np.asarray(first + _median(wrapped_deg(lonlat_deg - first)))


def wrapped_deg(difference_deg: FloatArray) -> FloatArray:
    """Return differences of longitude and latitude (..., 2), by the shorter way round."""
    longitude, latitude = np.moveaxis(difference_deg, -1, 0)
    return np.stack((longitude - 360.0 * np.round(longitude / 360.0), latitude), axis=-1)


def _median(xy: FloatArray) -> FloatArray:
    return np.asarray(np.median(xy, axis=0))


def place_text(crs: str, longitude_deg: float, latitude_deg: float) -> str:
    """Return a place in words: latitude, longitude and the area of its CRS."""
    area = area_of_use(crs)
    spot = _degrees(longitude_deg, latitude_deg)
    return spot if area is None else f"{spot}; {crs} is for: {_short(area.name)}"


def _degrees(longitude_deg: float, latitude_deg: float) -> str:
    north = "N" if latitude_deg >= 0.0 else "S"
    east = "E" if longitude_deg >= 0.0 else "W"
    return f"{abs(latitude_deg):.4f}° {north} {abs(longitude_deg):.4f}° {east}"


def _spot(longitude_deg: float, latitude_deg: float) -> str:
    if not np.isfinite(longitude_deg + latitude_deg) or abs(latitude_deg) > 90.0:
        return "nowhere on Earth"
    return f"at {_degrees(longitude_deg, latitude_deg)}"


def _short(name: str) -> str:
    """Return the name of a region; a long one is cut after one of its parts."""
    if len(name) <= _MAX_NAME_LENGTH:
        return name.removesuffix(".")
    end = max(name.rfind(mark, 0, _MAX_NAME_LENGTH) for mark in ";,:")
    return f"{name[: end if end > 0 else _MAX_NAME_LENGTH]} …"


def _outside(area: AreaOfUse | None, crs: str, xy: FloatArray) -> float:
    """Return how far a map point is outside the area [deg]; 0 if the area is unknown."""
    place = longitude_latitude(crs, xy[None])[0]
    if not np.isfinite(place).all() or np.any(np.abs(place) > 2.0 * _MAX_DEG):
        return 180.0
    if abs(float(place[1])) > 90.0:
        return 180.0
    return 0.0 if area is None else area.degrees_outside(float(place[0]), float(place[1]))


Guess = tuple[Cause, str, str]


def _angular_guess(area: AreaOfUse | None, crs: str, xy: FloatArray) -> Guess | None:
    """Return what the alleged longitude and latitude seem to be."""
    degrees = np.degrees(xy)
    if np.all(np.abs(xy) <= _MAX_RAD) and _outside(area, crs, degrees) < _NEAR_DEG:
        return (
            Cause.ANGLE_UNIT,
            f"in radians they would be {_degrees(*degrees.tolist())}",
            "give longitude and latitude in degrees",
        )
    if np.all(np.abs(xy) <= np.flip(_MAX_DEG)) and _outside(area, crs, xy[::-1]) < _NEAR_DEG:
        return (
            Cause.AXES_SWAPPED,
            "with x and y exchanged it fits",
            "put the longitude into x and the latitude into y",
        )
    if np.any(np.abs(xy) > _MAX_DEG):
        return (
            Cause.CRS,
            "these are not degrees; they seem to be metres",
            "give the projected CRS of the coordinates, for example EPSG:25832",
        )
    return None


def _projected_guess(area: AreaOfUse | None, crs: str, xy: FloatArray) -> Guess | None:
    """Return what the alleged easting and northing seem to be."""
    if _outside(area, crs, xy[::-1]) < _NEAR_DEG:
        return (
            Cause.AXES_SWAPPED,
            "with x and y exchanged it fits",
            "put the easting into x and the northing into y",
        )
    for values, words in _geographic_readings(xy):
        if area is not None and area.degrees_outside(*values) < _NEAR_DEG:
            return (
                Cause.CRS,
                f"these are {words}",
                "convert them, or give their CRS, such as EPSG:4326, with x = longitude",
            )
    zoned = np.array([xy[0] % _ZONE_FACTOR, xy[1]])
    if abs(xy[0]) > _ZONE_FACTOR and _outside(area, crs, zoned) < _NEAR_DEG:
        return (
            Cause.CRS,
            f"x seems to begin with a zone number, {xy[0] // _ZONE_FACTOR:.0f}",
            "remove it",
        )
    return None


def _geographic_readings(xy: FloatArray) -> Iterator[tuple[tuple[float, float], str]]:
    x, y = xy.tolist()
    units: tuple[tuple[FloatArray, Callable[[float], float], str], ...] = (
        (_MAX_RAD, lambda angle: float(np.degrees(angle)), "in radians"),
        (_MAX_DEG, lambda angle: angle, "in degrees"),
    )
    for limit, degrees, unit in units:
        if np.all(np.abs(xy) <= limit):
            yield (degrees(x), degrees(y)), f"longitude and latitude {unit}"
        if np.all(np.abs(xy) <= limit[::-1]):
            yield (degrees(y), degrees(x)), f"latitude and longitude {unit}"
