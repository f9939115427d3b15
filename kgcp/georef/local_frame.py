"""A map's local Cartesian frame, and the transformation from one map to another.

Map → the CRS's own geodetic coordinates (no datum shift) → Earth-centred Cartesian (ECEF) → local
east, north, up (ENU) in metres, tangent to the ellipsoid at an origin. Distances, lever arms and
attitudes are meaningful in ENU only: in the middle of a UTM zone, the grid shortens 80 m by 32 mm,
and its north is not true north.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from pyproj import Transformer
from pyproj.enums import TransformDirection
from pyproj.exceptions import ProjError

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import (
    CRS_KEY,
    VEHICLE_CRS,
    DatumTransform,
    best_transformer,
    geographic_of,
    is_geographic,
    parse_crs,
    unusable,
)

# Half the base of central differences. In these, curvature cancels; rounding stays below 1e-9.
_JACOBIAN_STEP_M = 10.0
_STEP_M, _STEP_DEG = 10.0, 1e-4  # the same along a map's y axis, projected and geographic


@dataclass(frozen=True, slots=True, eq=False)
class LocalFrame:
    """A map and a local ENU frame with its origin at one point of the map.

    Map coordinates are x = easting or longitude, y = northing or latitude, in this order and in
    the CRS's own units, and z = height. A compound CRS defines its heights itself; otherwise they
    are ellipsoidal and in metres.
    """

    crs: str  # as in flight.toml
    origin_ecef_m: FloatArray  # (3,): origin of the ENU frame, Earth-centred [m]
    ecef_from_enu: FloatArray  # (3, 3): directions east, north and up of the origin, as columns
    _geodetic_from_map: Transformer
    _ecef_from_geodetic: Transformer
    _radians_per_unit: float
    _where: str = CRS_KEY

    @classmethod
    def at(cls, crs: str, origin_map: FloatArray, where: str = CRS_KEY) -> Self:
        """Return the frame of `crs` (anything pyproj reads) over the point (3,) `origin_map`.

        `where` tells where the CRS was given; error messages begin with it.

        Raises
        ------
        KgcpError
            If the CRS is unknown or has no horizontal axes, if its heights need a grid that is
            not installed, or if the origin lies outside the projection's domain.
        """
        draft = cls(crs, np.zeros(3), np.eye(3), *_operations_of(crs, where), where)
        origin = np.reshape(np.asarray(origin_map, float), (1, 3))
        geodetic_origin = draft._geodetic(origin)
        return replace(
            draft,
            origin_ecef_m=draft._ecef(geodetic_origin, origin)[0],
            ecef_from_enu=_level_axes(geodetic_origin)[0],
        )

    def enu_from_map(self, xyz: FloatArray) -> FloatArray:
        """Transform map points (n, 3) into the ENU frame (n, 3) [m]."""
        points = np.asarray(xyz, dtype=np.float64)
        ecef = self._ecef(self._geodetic(points), points)
        return (ecef - self.origin_ecef_m) @ self.ecef_from_enu

    def map_from_enu(self, enu: FloatArray) -> FloatArray:
        """Transform points (n, 3) of the ENU frame [m] into the map (n, 3)."""
        geodetic = self._geodetic_from_enu(enu)
        geodetic[:, :2] /= self._radians_per_unit
        return self._transform(self._geodetic_from_map, geodetic, TransformDirection.INVERSE)

    @property
    def semi_axes_m(self) -> tuple[float, float]:
        """Semi-major and semi-minor axis of the ellipsoid [m]."""
        axes = np.array([[0.0, 0.0, 0.0], [0.0, 0.5 * np.pi, 0.0]])
        equator, pole = self._ecef(axes, axes)
        return float(equator[0]), float(pole[2])

    def geodetic_deg(self, enu: FloatArray) -> FloatArray:
        """Return longitude, latitude [deg] and ellipsoidal height [m] (n, 3) of ENU points.

        Their datum is that of the map.
        """
        geodetic = self._geodetic_from_enu(enu)
        geodetic[:, :2] = np.degrees(geodetic[:, :2])
        return geodetic

    def map_axes_enu(self, enu: FloatArray) -> FloatArray:
        """Return the Jacobians (..., 3, 3) d(map)/d(enu) at points (..., 3) of the ENU frame.

        Rows are map x, y, z in the CRS's units, columns metres east, north, up of the origin.
        """
        steps = _JACOBIAN_STEP_M * np.vstack((np.eye(3), -np.eye(3)))
        around = np.asarray(enu, dtype=np.float64)[..., None, :] + steps
        moved = self.map_from_enu(around.reshape(-1, 3)).reshape(around.shape)
        differences = moved[..., :3, :] - moved[..., 3:, :]
        if is_geographic(self.crs):  # longitudes jump by a whole turn at the antimeridian
            turn = 2.0 * np.pi / self._radians_per_unit
            differences[..., 0] -= turn * np.round(differences[..., 0] / turn)
        return np.asarray(np.swapaxes(differences, -1, -2)) / (2.0 * _JACOBIAN_STEP_M)

    def grid_rotation(self, enu: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from the map's axes to ENU at points (..., 3).

        Their columns are the directions of map x, y and z there, made orthonormal by polar
        decomposition. They contain the meridian convergence and the change of the vertical, but
        not the scale.

        Raises
        ------
        KgcpError
            If the map's axes are left-handed, or undefined at a point.
        """
        jacobian = self.map_axes_enu(enu)
        lengths = np.linalg.norm(jacobian, axis=-1, keepdims=True)
        if not np.all((lengths > 0.0) & np.isfinite(lengths)):  # for example deep inside the Earth
            raise KgcpError(
                f"{self._where} {self.crs!r}: the directions of its axes are not defined at a"
                " point of the file; give the CRS of the coordinates"
            )
        rows = jacobian / lengths
        left, _, right = np.linalg.svd(rows)
        enu_from_grid: FloatArray = np.swapaxes(left @ right, -1, -2)
        if np.any(np.linalg.det(enu_from_grid) < 0.0):
            raise KgcpError(
                f"{self._where} {self.crs!r} has left-handed axes;"
                " give a CRS whose axes are east and north (or west and south)"
            )
        return enu_from_grid

    def level_rotations(self, enu: FloatArray) -> FloatArray:
        """Return the rotations (n, 3, 3) from east, north, up at points (n, 3) to ENU axes."""
        return np.asarray(self.ecef_from_enu.T @ _level_axes(self._geodetic_from_enu(enu)))

    def _geodetic(self, xyz: FloatArray) -> FloatArray:
        """Return longitude, latitude [rad] and ellipsoidal height [m] (n, 3) of map points."""
        geodetic = self._transform(self._geodetic_from_map, xyz)
        geodetic[:, :2] *= self._radians_per_unit
        return geodetic

    def _geodetic_from_enu(self, enu: FloatArray) -> FloatArray:
        ecef = np.asarray(enu, dtype=np.float64) @ self.ecef_from_enu.T + self.origin_ecef_m
        return self._transform(self._ecef_from_geodetic, ecef, TransformDirection.INVERSE)

    def _ecef(self, geodetic: FloatArray, given: FloatArray) -> FloatArray:
        return self._transform(self._ecef_from_geodetic, geodetic, given=given)

    def _transform(
        self,
        transformer: Transformer,
        points: FloatArray,
        direction: TransformDirection = TransformDirection.FORWARD,
        given: FloatArray | None = None,
    ) -> FloatArray:
        """Transform points (n, 3); an error shows those `given` (n, 3), from which they come."""
        radians = transformer is self._ecef_from_geodetic
        try:
            x, y, z = points.T
            columns = transformer.transform(x, y, z, direction=direction, radians=radians)
        except ProjError as error:
            raise unusable(self.crs, error, self._where) from error
        result = np.column_stack(columns).astype(np.float64)
        invalid = np.flatnonzero(~np.isfinite(result).all(axis=1))
        if invalid.size:
            shown = points if given is None else given
            point = ", ".join(f"{value:.10g}" for value in shown[invalid[0]])
            raise KgcpError(
                f"{self._where} {self.crs!r} does not cover the point ({point});"
                " give the CRS of the coordinates, x = easting or longitude first"
            )
        return result


@lru_cache(maxsize=8)
def _operations_of(crs: str, where: str) -> tuple[Transformer, Transformer, float]:
    """Return the operations of `LocalFrame` for a CRS, and its geodetic unit [rad].

    PROJ takes 14 ms to find them, and a run has several frames of the same CRS.
    """
    horizontal = parse_crs(crs, where)
    geodetic = horizontal.geodetic_crs
    if geodetic is None or horizontal.is_geocentric:
        raise KgcpError(
            f"{where} {crs!r} has no easting and northing or longitude and latitude;"
            " give a projected or geographic CRS"
        )
    ellipsoid = geodetic.ellipsoid
    if ellipsoid is None:
        raise KgcpError(f"{where} {crs!r} has no ellipsoid; give a CRS that has one")
    geodetic_from_map = best_transformer(
        horizontal,
        geodetic.to_2d().to_3d(),  # in metres, also if the heights of `geodetic` are in feet
        f"{where} {crs!r}: the transformation from its heights to ellipsoidal ones",
        "give ellipsoidal heights and the horizontal CRS alone",
    )
    cart = Transformer.from_pipeline(
        f"+proj=cart +a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"
    )
    return geodetic_from_map, cart, geodetic.axis_info[0].unit_conversion_factor


def _level_axes(geodetic: FloatArray) -> FloatArray:
    """Return east, north, up (n, 3, 3), as columns in ECEF, at geodetic points (n, 3) [rad, m]."""
    longitude, latitude = geodetic[:, 0], geodetic[:, 1]
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    east = np.column_stack((-sin_lon, cos_lon, np.zeros_like(longitude)))
    north = np.column_stack((-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat))
    up = np.column_stack((cos_lat * cos_lon, cos_lat * sin_lon, sin_lat))
    return np.stack((east, north, up), axis=-1)


def map_axes_ecef(crs: str, position: FloatArray) -> FloatArray:
    """Return the axes x, y, z of a CRS at positions (n, 3), as columns in ECEF, (n, 3, 3).

    They are orthonormal: z is the ellipsoid's normal, y is the map's y made perpendicular to it.
    The axes of a geocentric CRS are those of ECEF.
    """
    parsed = parse_crs(crs, VEHICLE_CRS)
    if parsed.is_geocentric:
        return np.broadcast_to(np.eye(3), (len(position), 3, 3))
    local_frame = LocalFrame.at(crs, position[0], VEHICLE_CRS)
    step = np.array([0.0, _STEP_DEG if parsed.is_geographic else _STEP_M, 0.0])
    up = local_frame.level_rotations(local_frame.enu_from_map(position))[:, :, 2]
    along_y = local_frame.enu_from_map(position + step) - local_frame.enu_from_map(position - step)
    x = np.cross(along_y, up)
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return np.asarray(local_frame.ecef_from_enu @ np.stack((x, np.cross(up, x), up), axis=-1))


def level_axes_ecef(crs: str, position: FloatArray) -> FloatArray:
    """Return east, north, up at positions (n, 3) of a CRS, as columns in ECEF, (n, 3, 3)."""
    parsed = parse_crs(crs, VEHICLE_CRS)
    if parsed.is_geocentric:
        local_frame = LocalFrame.at(geographic_of(parsed), np.zeros(3), VEHICLE_CRS)
        enu = (position - local_frame.origin_ecef_m) @ local_frame.ecef_from_enu
    else:
        local_frame = LocalFrame.at(crs, position[0], VEHICLE_CRS)
        enu = local_frame.enu_from_map(position)
    return np.asarray(local_frame.ecef_from_enu @ local_frame.level_rotations(enu))


def turn_covariances(
    cov_m2: FloatArray, old_axes_ecef: FloatArray, new_axes_ecef: FloatArray
) -> FloatArray:
    """Rotate covariances (n, 3, 3) from one set of axes (n, 3, 3) to another."""
    turn = np.swapaxes(new_axes_ecef, -1, -2) @ old_axes_ecef
    return np.asarray(turn @ cov_m2 @ np.swapaxes(turn, -1, -2))


@dataclass(frozen=True, slots=True, eq=False)
class CrsTransform:
    """The transformation from the flight's map to another one, datum and geoid included."""

    source: LocalFrame  # of the flight's CRS
    target: LocalFrame  # of the other CRS
    _between: DatumTransform
    _where: str

    @classmethod
    def to(
        cls,
        crs: str,
        source: LocalFrame,
        near_map: FloatArray,
        where: str = "crs",
        *,
        time_s: float | None = None,
    ) -> Self:
        """Prepare the transformation to `crs` (anything pyproj reads).

        Parameters
        ----------
        near_map : (3,) array
            A point of the source map; the target's frame has its origin there.
        where : str
            Where the CRS was given; error messages begin with it.
        time_s : float or None
            When the coordinates were measured, Unix UTC [s]; None: not known.

        Raises
        ------
        KgcpError
            If the CRS is unknown or unusable, if no exact operation leads to it, or if that
            operation needs a grid that is not installed, or a date that is not known.
        """
        between = DatumTransform.between(
            source.crs,
            crs,
            near_map,
            where=f"{where} {crs!r}: the transformation from {source.crs!r}",
            remedy="give a CRS to which a better one is known, if the coordinates must be better",
            time_s=time_s,
            keys=(CRS_KEY, where),
        )
        where_named = f"{where} {crs!r}"
        draft = cls(source, source, between, where_named)
        target = LocalFrame.at(crs, draft.positions(np.reshape(near_map, (1, 3)))[0], where)
        return cls(source, target, between, where_named)

    def positions(self, xyz: FloatArray) -> FloatArray:
        """Transform points (n, 3) of the source map into the other one (n, 3)."""
        points = np.asarray(xyz, dtype=np.float64)
        try:
            return self._between.positions(points, errcheck=True)
        except ProjError as error:
            text = " ".join(str(error).split())
            raise KgcpError(
                f"{self._where}: points in {self.source.crs!r} cannot be transformed to it"
                f" ({text}); give one that covers the flight"
            ) from error

    def axes(self, xyz: FloatArray) -> FloatArray:
        """Return the rotations (..., 3, 3) from the source map's axes to the other's at (..., 3).

        Both maps are compared with east, north and up at the same place. These directions differ
        between datums by some 1e-5 rad, which does not matter for standard deviations.
        """
        points = np.reshape(np.asarray(xyz, dtype=np.float64), (-1, 3))
        from_source = _level_from_grid(self.source, points)
        from_target = _level_from_grid(self.target, self.positions(points))
        turned: FloatArray = np.swapaxes(from_target, 1, 2) @ from_source
        return turned.reshape(*np.shape(xyz), 3)


def _level_from_grid(local_frame: LocalFrame, xyz: FloatArray) -> FloatArray:
    enu = local_frame.enu_from_map(xyz)
    return np.asarray(
        np.swapaxes(local_frame.level_rotations(enu), 1, 2) @ local_frame.grid_rotation(enu)
    )
