"""GeoPackage for a map: the flight's own CRS, with heights.

By OGC 12-128r18 (GeoPackage 1.4): an SQLite file with the tables of clause 1, and one of features
whose geometries are well-known binary behind a header of eight bytes (clause 2.1.3). Written with
Python's own sqlite3: the result depends on the points alone, and no library is added for it.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping

from pyproj import CRS
from pyproj.enums import WktVersion

from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.points import CERTAIN, MapPoints
from kgcp.io.exporters.shared import ATTRIBUTES, attributes, well_known_text

_TABLE = "kgcps"
_APPLICATION_ID, _USER_VERSION = 0x47504B47, 10400  # "GPKG", 1.4.0
_NO_TIME = "1970-01-01T00:00:00.000Z"  # a required column; the same input gives the same bytes
_OWN_SRS = 100_000  # for a CRS that no authority knows
_SCHEMA = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT
  (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER, CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES
  gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL, CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name), CONSTRAINT fk_gc_tn FOREIGN KEY (table_name)
  REFERENCES gpkg_contents(table_name), CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES
  gpkg_spatial_ref_sys (srs_id));
"""
_HOWTO = """\
GeoPackage

Open kgcps.gpkg in QGIS or any GIS: one layer of points in {crs}, z is
{heights}. The attributes x, y, z repeat the coordinates; standard deviations
are in metres along the map's axes; role is control or check; (0, 0) px is the centre of the
top-left pixel.
No package for aerial triangulation reads control points from it.
"""


def files(points: MapPoints) -> Mapping[str, str | bytes]:
    """Return `kgcps.gpkg`."""
    connection = sqlite3.connect(":memory:")
    try:
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {_USER_VERSION}")
        connection.executescript(_SCHEMA)
        srs_id = _add_systems(connection, points)
        _add_layer(connection, points.gcps, srs_id)
        connection.commit()
        content = connection.serialize()
    finally:
        connection.close()
    how_to = _HOWTO.format(crs=points.crs, heights=points.heights)
    return {"geopackage/kgcps.gpkg": content, "geopackage/HOWTO.txt": how_to}


def _add_systems(connection: sqlite3.Connection, points: MapPoints) -> int:
    """Add the three systems that every GeoPackage has and the map's; return the latter's id."""
    crs = points.written_crs
    authority = None if crs.is_bound else crs.to_authority(min_confidence=CERTAIN)
    wgs84 = CRS.from_epsg(4326).to_wkt(WktVersion.WKT1_GDAL)
    rows: dict[int, tuple[str | int | None, ...]] = {
        -1: ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", None),
        0: ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
        4326: ("WGS 84", 4326, "EPSG", 4326, wgs84, None),
    }
    if authority is not None and authority[1].isdecimal():
        srs_id, organization = int(authority[1]), authority[0]
    else:
        srs_id, organization = _OWN_SRS, "NONE"
    definition = well_known_text(points, "geopackage", "GeoPackage")
    rows.setdefault(srs_id, (crs.name, srs_id, organization, srs_id, definition, points.crs))
    connection.executemany(
        "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", rows.values()
    )
    return srs_id


def _add_layer(connection: sqlite3.Connection, gcps: tuple[Gcp, ...], srs_id: int) -> None:
    columns = ", ".join(f'"{name}" {kind}' for name, kind in ATTRIBUTES.items())
    connection.execute(
        f"CREATE TABLE {_TABLE} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT,"
        f" {columns})"
    )
    xs, ys = zip(*(point.position_map[:2].tolist() for point in gcps), strict=True)
    connection.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (_TABLE, _TABLE, _NO_TIME, min(xs), min(ys), max(xs), max(ys), srs_id),
    )
    connection.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'POINT', ?, 1, 0)", (_TABLE, srs_id)
    )
    names = ", ".join(f'"{name}"' for name in ATTRIBUTES)
    marks = ", ".join("?" * (len(ATTRIBUTES) + 1))
    connection.executemany(
        f"INSERT INTO {_TABLE} (geom, {names}) VALUES ({marks})",  # noqa: S608 - names of ours
        ((_geometry(point, srs_id), *attributes(point).values()) for point in gcps),
    )


def _geometry(point: Gcp, srs_id: int) -> bytes:
    """Return header (magic, version 0, little-endian without envelope, system) and WKB point Z."""
    x, y, z = point.position_map.tolist()
    return struct.pack("<2sBBi", b"GP", 0, 1, srs_id) + struct.pack("<BI3d", 1, 1001, x, y, z)
