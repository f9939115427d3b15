"""Coordinate reference systems: reading them, and the best transformations between them by PROJ."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from pyproj import CRS, Proj, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.crs import GeographicCRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.geometry.arrays import FloatArray

CRS_KEY = "flight.toml: crs"
VEHICLE_CRS = "flight.toml: [vehicle] crs"
WGS84_3D = "EPSG:4979"
"""Longitude, latitude and ellipsoidal height of WGS 84."""
MAX_HEIGHT = 1e5
"""Largest credible height [m or ft], beyond any vehicle or aircraft."""
_MAX_INACCURACY_M = 0.1  # of an operation by PROJ's database, without a warning
_SAME_PLACE_DEG = 1e-7  # 1 cm
_YEAR_S = 365.2425 * 86400.0
_EARLIEST_S = 10.0 * _YEAR_S  # 1980, before GPS; times that count from a flight's start are earlier


def crs_of(text: str) -> CRS:
    """Return the CRS that a text names; heights are not added.

    Raises
    ------
    CRSError
        If pyproj cannot read it, or if it names a file of definitions by `+init=`. PROJ deprecates
        this, and would open any file so named.
    """
    if "init=" in text:
        raise CRSError("'init=' is no longer in use; write EPSG:25832 for +init=epsg:25832")
    return CRS.from_user_input(text)


def parse_crs(crs: str, where: str = CRS_KEY) -> CRS:
    """Return a CRS with heights: its own if it is compound, otherwise ellipsoidal ones in metres.

    Raises
    ------
    KgcpError
        If pyproj cannot read it. The message begins with `where`.
    """
    try:
        parsed = crs_of(crs)
    except ProjError as error:
        raise unusable(crs, error, where) from error
    while parsed.is_bound and parsed.source_crs is not None:  # its shift to WGS 84 is not needed
        parsed = parsed.source_crs
    return parsed if parsed.is_compound else parsed.to_3d()


def unusable(crs: str, error: ProjError, where: str) -> KgcpError:
    """Return the error for a CRS that PROJ cannot use."""
    text = " ".join(str(error).split())
    return KgcpError(f"{where} {crs!r} cannot be used ({text}); give one that pyproj reads")


def geographic_of(geocentric: CRS) -> str:
    """Return the geographic CRS with ellipsoidal heights that has a geocentric CRS's datum."""
    geographic = GeographicCRS(name=geocentric.name, datum=geocentric.datum)
    return str(geographic.to_3d().to_string())


def best_transformer(
    source: CRS,
    target: CRS,
    where: str,
    remedy: str = "give a CRS of the flight's datum and heights",
    area: AreaOfInterest | None = None,
) -> Transformer:
    """Return the best operation between two CRS; x is easting or longitude in both.

    A second-best operation can be metres off without any sign of it. The worst case is a missing
    geoid grid: if ballpark operations are allowed, PROJ silently leaves heights unchanged, so that
    heights above the geoid are taken as ellipsoidal. `only_best` alone does not prevent this.

    Parameters
    ----------
    where, remedy : str
        Beginning and end of messages: which transformation it is, and what to give instead.
    area : AreaOfInterest, optional
        Where the coordinates are. Without it, PROJ takes operations for best that are meant for
        another country, and asks for that country's grids.

    Raises
    ------
    KgcpError
        If no exact operation is known, or the best one needs a grid that is not installed.
    """
    unknown = KgcpError(f"{where} is not known exactly; {remedy}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a missing grid is an error below
        try:
            operations = TransformerGroup(
                source,
                target,
                always_xy=True,
                allow_ballpark=False,
                area_of_interest=area,  # type: ignore[arg-type]  # the stubs name another class
            )
        except IndexError:  # pyproj's, if PROJ knows operations and can use none of them
            raise unknown from None
    if area is not None and not operations.transformers + operations.unavailable_operations:
        return best_transformer(source, target, where, remedy)  # a CRS used beside its area
    if operations.best_available and operations.transformers:
        return Transformer.from_crs(
            source,
            target,
            always_xy=True,
            only_best=True,
            allow_ballpark=False,
            area_of_interest=area,  # type: ignore[arg-type]  # as above
        )
    grids = [grid for best in operations.unavailable_operations[:1] for grid in best.grids]
    missing = sorted({grid.short_name for grid in grids if not grid.available})
    if missing:
        raise KgcpError(
            f"{where} needs the grid {', '.join(missing)}, which is not installed; install it with"
            f" 'pyproj sync --file {missing[0]}', or {remedy}"
        )
    raise unknown


@dataclass(frozen=True, slots=True, eq=False)
class DatumTransform:
    """The best operation from one CRS to another, at the date of the coordinates."""

    _transformer: Transformer
    _year: float | None  # None: the date does not matter

    @classmethod
    def between(
        cls,
        source: str,
        target: str,
        point: FloatArray,
        *,
        where: str,
        remedy: str,
        time_s: float | None,
        keys: tuple[str, str] = (CRS_KEY, CRS_KEY),
    ) -> Self:
        """Prepare the operation between two CRS, anything that pyproj reads.

        Global frames such as ITRF and those that move with a continent (ETRS89, NAD83, GDA2020)
        drift apart by centimetres a year. Without a date, PROJ silently takes the epoch of its
        parameters and is decimetres off.

        The best operation may be good to metres. This causes a `KgcpWarning`, unless it leaves
        longitude and latitude as they are: WGS 84 counts as equal to ETRS89 and the like.

        Parameters
        ----------
        point : (3,) array
            A place of the coordinates, in the source.
        where, remedy : str
            Beginning and end of messages: which transformation it is, and what to do if it is good
            to metres only.
        time_s : float or None
            When the coordinates were measured, Unix UTC [s]; None: not known.
        keys : (str, str)
            Where source and target were given, for messages.

        Raises
        ------
        KgcpError
            As `best_transformer`, or if the operation depends on a date that is not known.
        """
        crs = parse_crs(source, keys[0]), parse_crs(target, keys[1])
        transformer = best_transformer(*crs, where, area=_area_about(source, point))
        early, late = (cls(transformer, year).positions(point[None]) for year in (2000.0, 2020.0))
        year = None
        if not np.array_equal(early, late, equal_nan=True):
            if time_s is None or time_s < _EARLIEST_S:
                raise KgcpError(
                    f"{where} depends on the date, because frames of reference drift apart, and the"
                    " date is not known; transform the coordinates beforehand"
                )
            year = 1970.0 + time_s / _YEAR_S
        prepared = cls(transformer, year)
        inaccuracy_m = prepared._inaccuracy_m(source, target, point)
        if inaccuracy_m > _MAX_INACCURACY_M:
            warnings.warn(
                f"{where} is good to {inaccuracy_m:g} m only, by PROJ's database; {remedy}",
                KgcpWarning,
                stacklevel=3,
            )
        return prepared

    def positions(self, points: FloatArray, *, errcheck: bool = False) -> FloatArray:
        """Transform points (n, 3).

        Raises
        ------
        ProjError
            With `errcheck`, if a point cannot be transformed; without it, such points are infinite.
        """
        x, y, z = points.T
        if self._year is None:
            return np.column_stack(self._transformer.transform(x, y, z, errcheck=errcheck))
        years = np.full(len(points), self._year)
        columns = self._transformer.transform(x, y, z, years, errcheck=errcheck)
        return np.column_stack(columns[:3])

    def _inaccuracy_m(self, source: str, target: str, point: FloatArray) -> float:
        """Return how inexact the operation is at a place [m]; 0: exact, null, or not known."""
        moved = self.positions(point[None])[0]
        try:
            operation = self._transformer.get_last_used_operation()
        except ProjError:  # it does nothing, or cannot be used there
            return 0.0
        shift_deg = _geographic_place(target, moved) - _geographic_place(source, point)
        is_on_earth = abs(moved[2]) < MAX_HEIGHT  # else a refusal follows
        is_shift = is_on_earth and bool(np.any(np.abs(shift_deg) > _SAME_PLACE_DEG))
        return max(0.0, float(operation.accuracy or 0.0)) if is_shift else 0.0


def convert_positions(
    file: str, position: FloatArray, source: str, target: str, time_s: float
) -> FloatArray:
    """Transform a trajectory's positions (n, 3), read from a file, from one CRS to another.

    Parameters
    ----------
    time_s : float
        The date of all positions, Unix UTC [s].

    Raises
    ------
    KgcpError
        As `DatumTransform.between`, or if a point is outside the operation's domain or higher than
        `MAX_HEIGHT`.
    """
    transform = DatumTransform.between(
        source,
        target,
        position[0],
        where=f"{file}: the transformation from {source!r} to the flight's crs {target!r}",
        remedy="name the base station's datum, such as ETRS89 (EPSG:4937), as [vehicle] crs if it"
        " leads there more exactly",
        time_s=time_s,
        keys=(VEHICLE_CRS, CRS_KEY),
    )
    converted = transform.positions(position)
    is_valid = np.isfinite(converted).all(axis=1)
    if not parse_crs(target).is_geocentric:
        is_valid &= np.abs(converted[:, 2]) < MAX_HEIGHT
    invalid = np.flatnonzero(~is_valid)
    if invalid.size:
        where = ", ".join(f"{value:.10g}" for value in position[invalid[0]])
        raise KgcpError(
            f"{file}: the point ({where}) of epoch {invalid[0] + 1} cannot be transformed to"
            f" {target!r}; correct the file, or [vehicle] crs in flight.toml (now {source!r})"
        )
    return converted


def wgs84_from_map(crs: str, positions: Sequence[FloatArray], where: str) -> FloatArray:
    """Return longitude, latitude [deg] and ellipsoidal height [m] (n, 3) of map points (n, 3).

    Raises
    ------
    KgcpError
        As `DatumTransform.between`, without a date; `where` is the format's name.
    """
    if not positions:
        return np.empty((0, 3))
    where = f"{where}: the transformation from {crs!r} to WGS 84"
    remedy = "if points must be better, use a format that takes the flight's crs"
    to_wgs84 = DatumTransform.between(
        crs, WGS84_3D, positions[0], where=where, remedy=remedy, time_s=None
    )
    return to_wgs84.positions(np.array(positions), errcheck=True)


@dataclass(frozen=True, slots=True)
class AreaOfUse:
    """Where a CRS is meant to be used."""

    name: str  # of the region, from PROJ's database
    # its bounds; west is larger than east if it crosses the antimeridian
    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float

    @property
    def is_world(self) -> bool:
        """Whether it covers all longitudes."""
        return self.east_deg - self.west_deg >= 360.0

    def degrees_outside(self, longitude_deg: float, latitude_deg: float) -> float:
        """Return how far a place is from the area, the larger of both coordinates [deg]."""
        width = (self.east_deg - self.west_deg) % 360.0 if not self.is_world else 360.0
        from_west = (longitude_deg - self.west_deg) % 360.0
        off_longitude = 0.0 if from_west <= width else min(from_west - width, 360.0 - from_west)
        off_latitude = max(self.south_deg - latitude_deg, latitude_deg - self.north_deg, 0.0)
        return max(off_longitude, off_latitude)


@lru_cache(maxsize=8)
def area_of_use(crs: str) -> AreaOfUse | None:
    """Return where a CRS is meant to be used; None: PROJ does not know.

    Raises
    ------
    KgcpError
        If pyproj cannot read the CRS.
    """
    parsed = parse_crs(crs)
    area = parsed.area_of_use or next(
        (part.area_of_use for part in parsed.sub_crs_list if part.area_of_use), None
    )
    if area is None:
        return None
    return AreaOfUse(area.name, area.west, area.south, area.east, area.north)


@lru_cache(maxsize=8)
def is_geographic(crs: str) -> bool:
    """Tell whether the coordinates are longitude and latitude.

    Raises
    ------
    KgcpError
        If pyproj cannot read the CRS.
    """
    return bool(parse_crs(crs).is_geographic)


def grid_scale(crs: str, longitude_deg: float, latitude_deg: float) -> float:
    """Return the factor by which a projection stretches lengths at a place: the mean of both axes.

    1 if the CRS is not projected, or PROJ does not know.

    Raises
    ------
    KgcpError
        If pyproj cannot read the CRS.
    """
    parsed = parse_crs(crs)
    horizontal = parsed.sub_crs_list[0] if parsed.is_compound else parsed.to_2d()
    if not horizontal.is_projected:
        return 1.0
    try:
        factors = Proj(horizontal).get_factors(longitude_deg, latitude_deg)
    except ProjError:
        return 1.0
    return math.sqrt(factors.areal_scale) if math.isfinite(factors.areal_scale) else 1.0


def longitude_latitude(crs: str, xy: FloatArray) -> FloatArray:
    """Return longitude and latitude (n, 2) in the CRS's datum of map points (n, 2) [deg].

    Longitudes count from Greenwich. NaN for points outside the map's domain.

    Raises
    ------
    KgcpError
        If pyproj cannot read the CRS.
    """
    transformer, degrees_per_unit, meridian_deg = _to_longitude_latitude(crs)
    if transformer is None:
        return np.full(xy.shape, np.nan)
    x, y = xy.T
    columns = degrees_per_unit * np.column_stack(transformer.transform(x, y))
    columns[:, 0] += meridian_deg
    columns[~np.isfinite(columns).all(axis=1)] = np.nan
    return columns


def _geographic_place(crs: str, point: FloatArray) -> FloatArray:
    """Return longitude and latitude (2,) in the CRS's datum of a point (3,) [deg]."""
    parsed = parse_crs(crs)
    if not parsed.is_geocentric:
        return np.asarray(longitude_latitude(crs, point[None, :2])[0])
    geographic = CRS.from_user_input(geographic_of(parsed))
    to_geographic = Transformer.from_crs(parsed, geographic, always_xy=True)
    return np.array(to_geographic.transform(*point)[:2], dtype=np.float64)


def _area_about(crs: str, point: FloatArray) -> AreaOfInterest | None:
    """Return the place of a point (3,) as an area; None: it is nowhere on Earth."""
    longitude, latitude = _geographic_place(crs, point).tolist()
    if not np.isfinite(longitude) or not abs(latitude) <= 90.0:
        return None
    longitude = (longitude + 180.0) % 360.0 - 180.0
    return AreaOfInterest(longitude, latitude, longitude, latitude)


@lru_cache(maxsize=8)
def _to_longitude_latitude(crs: str) -> tuple[Transformer | None, float, float]:
    """Return the way to the geographic CRS, the degrees of its unit, and its prime meridian."""
    parsed = parse_crs(crs)
    horizontal = parsed.sub_crs_list[0] if parsed.is_compound else parsed.to_2d()
    geodetic = horizontal.geodetic_crs
    if geodetic is None:
        return None, 1.0, 0.0
    meridian = geodetic.prime_meridian
    meridian_rad = 0.0
    if meridian is not None:
        meridian_rad = meridian.longitude * float(meridian.unit_conversion_factor)
    return (
        Transformer.from_crs(horizontal, geodetic.to_2d(), always_xy=True),
        float(np.degrees(geodetic.axis_info[0].unit_conversion_factor)),
        float(np.degrees(meridian_rad)),
    )


@lru_cache(maxsize=8)
def geoid_height_m(longitude_deg: float, latitude_deg: float) -> float | None:
    """Return the height of the EGM2008 or EGM96 geoid above WGS 84; None: no grid is installed."""
    for model in ("EPSG:3855", "EPSG:5773"):
        try:
            to_ellipsoid = best_transformer(
                CRS.from_user_input(f"EPSG:4326+{model.removeprefix('EPSG:')}"),
                CRS.from_user_input(WGS84_3D),
                model,
            )
        except KgcpError:
            continue
        height = float(to_ellipsoid.transform(longitude_deg, latitude_deg, 0.0)[2])
        if np.isfinite(height):
            return height
    return None
