"""GeoJSON and GeoPackage, read back by GDAL."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from kgcp.errors import KgcpError
from kgcp.io.exporters import geojson, geopackage
from kgcp.io.exporters.points import MapPoints
from kgcp.io.exporters.write import export
from tests.io.exporters.conftest import OWN_DATUM


def test_gdal_reads_the_geopackage(points: MapPoints, tmp_path: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    export(points, "geopackage", tmp_path)
    table = geopandas.read_file(tmp_path / "geopackage" / "kgcps.gpkg", engine="pyogrio")
    assert table.crs == CRS.from_epsg(25831)
    assert list(table["id"]) == [point.id for point in points.gcps]
    expected = np.array([point.position_map for point in points.gcps])
    got = np.array([(place.x, place.y, place.z) for place in table.geometry])
    np.testing.assert_allclose(got, expected, atol=1e-6, rtol=0)
    np.testing.assert_allclose(table[["x", "y", "z"]].to_numpy(), expected, atol=1e-6, rtol=0)
    pixels = np.array([point.centre_px for point in points.gcps])
    np.testing.assert_allclose(table[["x_px", "y_px"]].to_numpy(), pixels, atol=1e-6)
    np.testing.assert_allclose(table[["sd_x", "sd_y", "sd_z"]].to_numpy()[0], [0.02, 0.03, 0.04])
    assert list(table["role"]).count("check") == 1
    assert table["time"][0] == "2026-05-04T09:30:01.000000Z"


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:4326",
        "EPSG:4979",
        "EPSG:2263+6360",
        "+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80 +type=crs",
        "+proj=tmerc +lat_0=0 +lon_0=12 +x_0=4500000 +ellps=bessel +type=crs",
    ],
)
def test_the_geopackage_can_hold_any_crs(in_degrees: MapPoints, tmp_path: Path, crs: str) -> None:
    pyogrio = pytest.importorskip("pyogrio")
    export(replace(in_degrees, crs=crs), "geopackage", tmp_path)
    information = pyogrio.read_info(tmp_path / "geopackage" / "kgcps.gpkg")
    got = CRS.from_user_input(information["crs"])
    wanted = CRS.from_user_input(crs)
    assert got.equals(wanted if wanted.is_compound else wanted.to_2d(), ignore_axis_order=True)
    assert information["geometry_type"] == "Point Z"
    np.testing.assert_allclose(information["total_bounds"][0], 2.1701234567, atol=1e-9)


def test_the_geopackage_keeps_the_datum_of_a_proj_string(
    in_degrees: MapPoints, tmp_path: Path
) -> None:
    export(replace(in_degrees, crs=OWN_DATUM), "geopackage", tmp_path)
    with contextlib.closing(sqlite3.connect(tmp_path / "geopackage" / "kgcps.gpkg")) as package:
        (row,) = package.execute(
            "SELECT organization, definition FROM gpkg_spatial_ref_sys WHERE srs_id > 4326"
        )
    assert row[0] == "NONE"
    assert "TOWGS84[598.1,73.7,418.2,0.202,0.045,-2.455,6.7]" in row[1]


def test_a_crs_without_well_known_text_1_is_a_one_line_error(
    points: MapPoints, tmp_path: Path
) -> None:
    bogota = replace(points, crs="EPSG:6247", priors=())
    with pytest.raises(KgcpError, match=r"^geopackage: crs 'EPSG:6247' has no form"):
        export(bogota, "geopackage", tmp_path)
    assert not list(tmp_path.rglob("*.gpkg"))


def test_the_same_points_make_the_same_geopackage(points: MapPoints) -> None:
    again = replace(points)
    assert geopackage.files(points) == geopackage.files(again)


def test_geojson_is_in_wgs84_with_longitude_first(points: MapPoints) -> None:
    collection = json.loads(geojson.files(points)["geojson/kgcps.geojson"])
    assert collection["type"] == "FeatureCollection"
    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:25831", always_xy=True)
    for feature, point in zip(collection["features"], points.gcps, strict=True):
        longitude, latitude, height = feature["geometry"]["coordinates"]
        assert 2.0 < longitude < 3.0
        assert 41.0 < latitude < 42.0
        back = (*to_grid.transform(longitude, latitude), height)
        np.testing.assert_allclose(back, point.position_map, atol=1e-6, rtol=0)
        assert feature["properties"]["id"] == point.id
        assert feature["properties"]["crs"] == "EPSG:25831"


def test_gdal_reads_the_geojson(points: MapPoints, tmp_path: Path) -> None:
    geopandas = pytest.importorskip("geopandas")
    export(points, "geojson", tmp_path)
    table = geopandas.read_file(tmp_path / "geojson" / "kgcps.geojson", engine="pyogrio")
    assert table.crs.to_2d() == CRS.from_epsg(4326)
    assert len(table) == 7
    assert table.geometry[2].z == pytest.approx(points.gcps[2].position_map[2], abs=1e-6)
