from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.exporters import odm
from kgcp.io.exporters.points import MapPoints
from tests.io.exporters.conftest import OWN_DATUM

Factory = Callable[..., MapPoints]


def _moved(points: MapPoints, position: tuple[float, float, float]) -> MapPoints:
    return replace(points, gcps=(replace(points.gcps[0], position_map=np.array(position)),))


def _lines(points: MapPoints) -> list[str]:
    return str(odm.files(points)["odm/gcp_list.txt"]).splitlines()


def _rows(points: MapPoints) -> list[list[str]]:
    """By opendm/gcp.py: columns separated by white space, `#` begins a comment."""
    return [line.split() for line in _lines(points)[1:] if not line.startswith("#")]


def test_odm_reads_the_same_points_and_pixels(points: MapPoints) -> None:
    rows = _rows(points)
    assert len(rows) == 6  # without the point that is kept for checking
    assert rows[0][5:] == ["IMG_1.JPG", "K0001"]
    for row, point in zip(rows, points.controls, strict=True):
        assert len(row) == 7
        np.testing.assert_allclose([*map(float, row[:3])], point.position_map, atol=1e-6, rtol=0)
        # ODM's (0, 0) is the centre of the first pixel, too: its left lower corner is -0.5.
        np.testing.assert_allclose([*map(float, row[3:5])], point.centre_px, atol=1e-6, rtol=0)


def test_the_list_states_the_order_of_its_columns(points: MapPoints) -> None:
    _, order, note = _lines(points)[:3]
    assert order == "# x (easting or longitude), y, height [m], pixel x, y, image, point"
    assert note.startswith("#")
    assert "--force-gps" in note


def test_odm_merges_static_targets_but_not_alike_points(points: MapPoints) -> None:
    places: dict[tuple[str, ...], set[str]] = {}
    for row in _rows(points):
        places.setdefault(tuple(row[:3]), set()).add(row[6])
    assert all(len(names) == 1 for names in places.values())
    assert sum("north_gate" in names for names in places.values()) == 1
    assert len(places) == 5


def test_odm_gets_heights_in_metres_whatever_the_crs_has(points: MapPoints) -> None:
    feet = _moved(replace(points, crs="EPSG:2263+6360", priors=()), (987000.0, 200000.0, 100.0))
    assert _lines(feet)[0] == "EPSG:2263"
    x, y, z = map(float, _rows(feet)[0][:3])
    assert (x, y) == (987000.0, 200000.0)  # ODM transforms these itself
    assert z == pytest.approx(30.48006, abs=1e-5)


def test_odm_gets_longitude_first_with_millimetre_digits(in_degrees: MapPoints) -> None:
    assert _lines(in_degrees)[0] == "EPSG:4326"
    x, y, _ = map(float, _rows(in_degrees)[0][:3])
    assert (x, y) == pytest.approx((2.1701234567, 41.4007654321), abs=1e-11)


@pytest.mark.parametrize(
    ("crs", "header"),
    [
        ("EPSG:32731", "WGS84 UTM 31S"),
        ("EPSG:32609", "WGS84 UTM 9N"),
        ("+proj=tmerc +lat_0=41 +lon_0=2 +ellps=GRS80", None),
        ("+proj=utm +zone=32 +ellps=GRS80 +towgs84=100,50,20", None),  # not ETRS89
        ("+proj=utm +zone=32 +datum=WGS84", None),
        (OWN_DATUM, None),
        ("EPSG:32664", None),  # in feet, and no UTM zone 64
        ("EPSG:32661", None),
    ],
)
def test_the_odm_header_names_the_crs(points: MapPoints, crs: str, header: str | None) -> None:
    assert _lines(replace(points, crs=crs, priors=()))[0] == (header or crs)


def test_odm_needs_a_code_or_a_proj_string(points: MapPoints) -> None:
    local = (
        'PROJCRS["site",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["GRS80",6378137,298.257222101]]],'
        'CONVERSION["c",METHOD["Transverse Mercator"],PARAMETER["Latitude of natural origin",41,'
        'ANGLEUNIT["degree",0.0174532925199433]]],CS[Cartesian,2],AXIS["e",east],AXIS["n",north],'
        'LENGTHUNIT["metre",1]]'
    )
    with pytest.raises(KgcpError, match="no EPSG code"):
        odm.files(replace(points, crs=local, priors=()))


def test_odm_refuses_names_that_would_break_its_columns(points: MapPoints) -> None:
    spaced = replace(points.gcps[0], frame="a/IMG 1.JPG")
    with pytest.raises(KgcpError, match="white space"):
        odm.files(replace(points, gcps=(spaced,)))
    namesake = replace(points.gcps[1], frame="b/IMG_1.JPG")
    with pytest.raises(KgcpError, match="same file name"):
        odm.files(replace(points, gcps=(points.gcps[0], namesake)))


def test_geo_has_positions_angles_and_accuracies(points: MapPoints) -> None:
    lines = str(odm.files(points)["odm/geo.txt"]).splitlines()
    assert lines[0] == "EPSG:25831"
    cells = lines[1].split()
    assert len(cells) == 9
    assert cells[0] == "IMG_1.JPG"
    prior = points.priors[0]
    np.testing.assert_allclose([*map(float, cells[1:4])], prior.position_map, atol=1e-6, rtol=0)
    assert float(cells[7]) == pytest.approx(0.4, rel=1e-3)  # the worse of the two
    assert float(cells[8]) == pytest.approx(0.1, rel=1e-3)


def test_yaw_is_against_true_north_and_zero_with_north_on_top(points: MapPoints) -> None:
    """A camera that looks straight down, turned by yaw: opendm/photo.py's own comment."""
    yaw_grid = 90.0  # the image's top points east
    attitude = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    prior = replace(points.priors[0], map_from_camera=attitude)
    lines = str(odm.files(replace(points, priors=(prior,)))["odm/geo.txt"]).splitlines()
    yaw, pitch, roll = map(float, lines[1].split()[4:7])
    longitude, latitude = 2.1700, 41.4007  # of the point; the zone's meridian is 3°
    convergence = math.degrees(
        math.atan(math.tan(math.radians(longitude - 3.0)) * math.sin(math.radians(latitude)))
    )
    assert yaw == pytest.approx(yaw_grid + convergence, abs=2e-3)
    assert (pitch, roll) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_yaw_pitch_and_roll_turn_a_camera_as_odm_does(points: MapPoints) -> None:
    """By opendm/photo.py: NED ← body by yaw, pitch, roll; body x is the image's up, y its right."""
    yaw, pitch, roll = np.radians([-123.0, 11.0, -7.0])
    about_z = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    about_y = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    about_x = [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    ned_from_body = np.array(about_z) @ about_y @ about_x
    body_from_image = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # x right, y up, z back
    image_from_camera = np.diag([1.0, -1.0, -1.0])
    enu_from_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    attitude = enu_from_ned @ ned_from_body @ body_from_image @ image_from_camera
    on_meridian = np.array([500000.0, 4583523.0, 200.0])  # where grid north is true north
    prior = replace(points.priors[0], map_from_camera=attitude, position_map=on_meridian)
    lines = str(odm.files(replace(points, priors=(prior,)))["odm/geo.txt"]).splitlines()
    angles = [*map(float, lines[1].split()[4:7])]
    np.testing.assert_allclose(angles, [-123.0, 11.0, -7.0], rtol=0, atol=1e-6)


def test_unknown_accuracies_are_not_invented(points: MapPoints) -> None:
    prior = replace(points.priors[0], cov=None)
    lines = str(odm.files(replace(points, priors=(prior,)))["odm/geo.txt"]).splitlines()
    assert len(lines[1].split()) == 7


def test_how_to_names_the_option_that_matters(make_points: Factory) -> None:
    texts = odm.files(make_points())
    assert set(texts) == {"odm/gcp_list.txt", "odm/HOWTO.txt"}
    assert "--force-gps" in texts["odm/HOWTO.txt"]
