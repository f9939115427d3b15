from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kgcp.errors import KgcpError
from kgcp.georef.local_frame import LocalFrame

_UTM31 = LocalFrame.at("EPSG:25831", np.array([430606.1, 4583523.0, 120.0]))


def test_80_m_on_the_grid_of_a_central_meridian_are_32_mm_longer_on_the_ellipsoid() -> None:
    local_frame = LocalFrame.at("EPSG:25831", np.array([500000.0, 4583000.0, 0.0]))
    ends = local_frame.enu_from_map(
        np.array([[500080.0, 4583000.0, 0.0], [500000.0, 4583080.0, 0.0]])
    )
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), 80.0 + 0.032, atol=1e-4)


def test_height_stretches_horizontal_lengths_by_the_earths_radius() -> None:
    low = LocalFrame.at("EPSG:25831", np.array([500000.0, 4583000.0, 0.0]))
    high = LocalFrame.at("EPSG:25831", np.array([500000.0, 4583000.0, 1000.0]))
    on_low = low.enu_from_map(np.array([[500100.0, 4583000.0, 0.0]]))
    on_high = high.enu_from_map(np.array([[500100.0, 4583000.0, 1000.0]]))
    stretch = np.linalg.norm(on_high) / np.linalg.norm(on_low) - 1.0
    assert stretch == pytest.approx(1000.0 / 6.387e6, rel=2e-3)  # prime vertical at 41.4 deg north


def test_meridian_convergence_is_delta_longitude_times_sine_of_latitude() -> None:
    rotation = _UTM31.grid_rotation(np.zeros(3))
    convergence_deg = math.degrees(math.atan2(rotation[0, 1], rotation[1, 1]))  # grid from true N
    assert convergence_deg == pytest.approx(
        (2.16984 - 3.0) * math.sin(math.radians(41.4)), abs=1e-3
    )
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_jacobian_of_utm_is_the_scale_factor_times_a_rotation() -> None:
    jacobian = _UTM31.map_axes_enu(np.zeros(3))
    scale = math.sqrt(np.linalg.det(jacobian[:2, :2]))
    expected = 0.9996 * (1.0 + (430606.1 - 500000.0) ** 2 / (2.0 * 6.371e6**2))
    assert scale == pytest.approx(expected * (1.0 - 120.0 / 6.371e6), abs=2e-6)
    assert jacobian[2, 2] == pytest.approx(1.0, abs=1e-9)


@given(
    st.floats(-2000.0, 2000.0),
    st.floats(-2000.0, 2000.0),
    st.floats(-100.0, 500.0),
    st.sampled_from(["EPSG:25831", "EPSG:4326", "EPSG:2154"]),
)
@settings(max_examples=40, deadline=None)
def test_map_and_enu_undo_each_other(east: float, north: float, up: float, crs: str) -> None:
    origin = {"EPSG:25831": (430606.1, 4583523.0), "EPSG:4326": (2.17, 41.4)}.get(
        crs, (650000.0, 6860000.0)
    )
    local_frame = LocalFrame.at(crs, np.array([*origin, 120.0]))
    enu = np.array([[east, north, up]])
    np.testing.assert_allclose(
        local_frame.enu_from_map(local_frame.map_from_enu(enu)), enu, atol=1e-6
    )


def test_longitude_comes_first_whatever_the_authority_says() -> None:
    local_frame = LocalFrame.at("EPSG:4326", np.array([2.17, 41.4, 0.0]))
    east = local_frame.enu_from_map(np.array([[2.171, 41.4, 0.0]]))[0]
    assert east[0] == pytest.approx(83.62, abs=0.01)
    assert abs(east[1]) < 0.01


def test_us_survey_feet_are_converted_but_ellipsoidal_heights_are_metres() -> None:
    local_frame = LocalFrame.at("EPSG:2263", np.array([987000.0, 200000.0, 100.0]))
    moved = local_frame.enu_from_map(
        np.array([[988000.0, 200000.0, 100.0], [987000.0, 200000.0, 101.0]])
    )
    assert np.linalg.norm(moved[0]) == pytest.approx(304.8006, abs=0.02)
    assert moved[1, 2] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "place"),
    [
        ("+proj=longlat +ellps=GRS80 +vunits=us-ft +type=crs", [-75.0, 40.0, 100.0]),
        ("+proj=utm +zone=18 +ellps=GRS80 +vunits=us-ft +type=crs", [500000.0, 4400000.0, 100.0]),
    ],
)
def test_a_crs_may_have_its_heights_in_feet(crs: str, place: list[float]) -> None:
    local_frame = LocalFrame.at(crs, np.array(place))
    above = local_frame.enu_from_map(np.array([place]) + np.array([0.0, 0.0, 100.0]))[0]
    assert above[2] == pytest.approx(100.0 * 1200.0 / 3937.0, abs=1e-6)
    assert local_frame.map_from_enu(above[None])[0, 2] == pytest.approx(place[2] + 100.0, abs=1e-6)


def test_grads_and_another_prime_meridian_make_no_difference_to_lengths() -> None:
    local_frame = LocalFrame.at(
        "EPSG:4807", np.array([2.0, 50.0, 0.0])
    )  # NTF (Paris), 50 gon = 45 deg
    north = local_frame.enu_from_map(np.array([[2.0, 50.01, 0.0]]))[0]
    meridian_radius_m = 6367345.0  # Clarke 1880 (IGN) at 45 deg
    assert north[1] == pytest.approx(math.radians(0.009) * meridian_radius_m, rel=1e-4)


def test_verticals_of_distant_points_differ_by_the_earth_s_curvature() -> None:
    turned = _UTM31.level_rotations(np.array([[0.0, 0.0, 0.0], [0.0, 10_000.0, 0.0]]))
    np.testing.assert_allclose(turned[0], np.eye(3), atol=1e-12)
    tilt = math.acos(turned[1][2, 2])
    assert tilt == pytest.approx(10_000.0 / 6.36e6, rel=5e-3)
    assert turned[1][1, 2] > 0.0  # up leans to the north


def test_a_shift_to_wgs84_in_the_crs_is_not_applied() -> None:
    plain = LocalFrame.at("+proj=utm +zone=31 +ellps=GRS80", _UTM31_ORIGIN)
    shifted = LocalFrame.at("+proj=utm +zone=31 +ellps=GRS80 +towgs84=100,200,300", _UTM31_ORIGIN)
    np.testing.assert_allclose(shifted.origin_ecef_m, plain.origin_ecef_m, atol=1e-6)


_UTM31_ORIGIN = np.array([430606.1, 4583523.0, 120.0])


@pytest.mark.parametrize(
    ("crs", "word"),
    [
        ("EPSG:99999", "EPSG:99999"),
        ("nonsense", "nonsense"),
        ("", "pyproj reads"),
        ("EPSG:4978", "no easting"),
        ("EPSG:5773", "no easting"),
        ('LOCAL_CS["site",UNIT["m",1]]', "no easting"),
    ],
)
def test_an_unusable_crs_is_one_line_that_says_why(crs: str, word: str) -> None:
    with pytest.raises(KgcpError) as caught:
        LocalFrame.at(crs, _UTM31_ORIGIN)
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_heights_above_a_geoid_are_transformed_or_refused_but_never_taken_as_ellipsoidal() -> None:
    plain = LocalFrame.at("EPSG:25831", _UTM31_ORIGIN)
    try:
        local_frame = LocalFrame.at("EPSG:25831+5773", _UTM31_ORIGIN)
    except KgcpError as error:  # the usual machine: the grid is not installed
        message = str(error)
    else:
        shift = np.linalg.norm(local_frame.origin_ecef_m - plain.origin_ecef_m)
        assert 45.0 < shift < 55.0  # the geoid at Barcelona
        return
    assert "us_nga_egm96_15.tif" in message
    assert "\n" not in message


def test_coordinates_outside_the_projection_are_an_error() -> None:
    with pytest.raises(KgcpError, match="does not cover the point"):
        LocalFrame.at("EPSG:25831", np.array([1e30, 0.0, 0.0]))
    metres = np.array([689_588.057, 5_336_252.148, 556.8])
    words = r"does not cover the point \(689588.057, 5336252.148, 556.8\); give the CRS"
    with pytest.raises(KgcpError, match=words):
        LocalFrame.at("EPSG:4326", metres)
    with pytest.raises(KgcpError, match=words):
        LocalFrame.at("EPSG:4326", np.array([11.5, 48.1, 556.8])).enu_from_map(metres[None])


def test_the_axes_are_those_of_east_and_north_also_at_the_antimeridian() -> None:
    for crs, half_turn in (("EPSG:4326", 180.0), ("EPSG:4807", 200.0)):  # the latter in grads
        local_frame = LocalFrame.at(crs, np.array([half_turn - 1e-5, -17.0, 0.0]))
        np.testing.assert_allclose(local_frame.grid_rotation(np.zeros(3)), np.eye(3), atol=1e-6)
        east = local_frame.map_from_enu(np.array([[20.0, 0.0, 0.0]]))[0]
        assert east[0] == pytest.approx(-half_turn, abs=1e-3)


def test_left_handed_axes_are_refused() -> None:
    local_frame = LocalFrame.at("EPSG:2065", np.array([700000.0, 1100000.0, 200.0]))
    with pytest.raises(KgcpError, match="left-handed"):
        local_frame.grid_rotation(np.zeros(3))
