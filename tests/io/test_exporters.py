from __future__ import annotations

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.exporters import odm
from kgcp.io.exporters.points import MapPoints
from kgcp.kgcps import Kgcp


def _points(crs: str, position: tuple[float, float, float], point_id: str = "K0001") -> MapPoints:
    point = Kgcp(
        id=point_id,
        frame="sub/a.jpg",
        target="A",
        time_s=0.0,
        position_map=np.array(position),
        cov_m2=None,
        centre_px=np.array([10.25, 20.5]),
        centre_cov_px2=None,
        distance_m=50.0,
        sd_distance_m=None,
        sd_common_distance_m=0.0123456789,
    )
    return MapPoints(crs, (point,))


def _odm_lines(points: MapPoints) -> list[str]:
    return odm.files(points)["gcp_list.txt"].splitlines()


def test_odm_gets_heights_in_metres_whatever_the_crs_has() -> None:
    lines = _odm_lines(_points("EPSG:2263+6360", (987000.0, 200000.0, 100.0)))
    assert lines[0] == "EPSG:2263"
    x, y, z, *_ = lines[-1].split()
    assert (float(x), float(y)) == (987000.0, 200000.0)  # ODM transforms these itself
    assert float(z) == pytest.approx(30.48006, abs=1e-5)


def test_odm_gets_longitude_first_with_millimetre_digits() -> None:
    lines = _odm_lines(_points("EPSG:4258", (2.17, 41.4, 100.0)))
    assert lines[0] == "EPSG:4258"
    assert lines[-1].split()[:2] == ["2.1700000000", "41.4000000000"]


@pytest.mark.parametrize(
    ("crs", "header"),
    [
        ("EPSG:32731", "WGS84 UTM 31S"),
        ("EPSG:32609", "WGS84 UTM 9N"),
        ("+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80", None),
    ],
)
def test_odm_headers(crs: str, header: str | None) -> None:
    assert _odm_lines(_points(crs, (430000.0, 4583000.0, 100.0)))[0] == (header or crs)


def test_odm_needs_a_code_or_a_proj_string() -> None:
    local = (
        'PROJCRS["site",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["GRS80",6378137,298.257222101]]],'
        'CONVERSION["c",METHOD["Transverse Mercator"],PARAMETER["Latitude of natural origin",41,'
        'ANGLEUNIT["degree",0.0174532925199433]]],CS[Cartesian,2],AXIS["e",east],AXIS["n",north],'
        'LENGTHUNIT["metre",1]]'
    )
    with pytest.raises(KgcpError, match="no EPSG code"):
        odm.files(_points(local, (0.0, 0.0, 0.0)))


def test_odm_labels_have_no_white_space_and_images_no_folder() -> None:
    line = _odm_lines(_points("EPSG:25831", (430000.0, 4583000.0, 100.0), "north gate"))[-1]
    assert line.split()[3:] == ["10.2500", "20.5000", "a.jpg", "north_gate"]
