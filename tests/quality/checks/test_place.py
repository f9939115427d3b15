from __future__ import annotations

import numpy as np
import pytest

from kgcp.georef.crs import area_of_use, longitude_latitude
from kgcp.quality.checks.camera_position import check_altitude, check_camera_position
from kgcp.quality.checks.doubt import Cause
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.quality.checks.place import (
    check_export_crs,
    check_grid_scale,
    check_place,
    place_text,
)

# CRS, x and y of a place where it is used
PLACES = [
    ("EPSG:25832", 689586.0, 5336252.0),
    ("EPSG:25832", 860000.0, 5400000.0),  # 13.9° E: Passau uses zone 32, too
    ("EPSG:25832+7837", 689586.0, 5336252.0),
    ("EPSG:4326", 11.549, 48.151),
    ("EPSG:4979", -70.6, -33.4),
    ("EPSG:4258", 11.549, 48.151),
    ("EPSG:32719", 350000.0, 6300000.0),  # Santiago
    ("EPSG:28355", 320000.0, 5812000.0),  # Melbourne
    ("EPSG:2056", 2600000.0, 1200000.0),  # Bern
    ("EPSG:27700", 530000.0, 180000.0),  # London
    ("EPSG:2264", 1450000.0, 540000.0),  # North Carolina, US survey feet
    ("EPSG:32760", 300000.0, 5100000.0),  # New Zealand, near the antimeridian
    ("EPSG:3857", 1285600.0, 6133000.0),
    ("EPSG:27571", 600000.0, 1330000.0),  # France's north, whose longitudes are grads from Paris
    ("+proj=utm +zone=32 +ellps=GRS80", 689586.0, 5336252.0),
]


@pytest.mark.parametrize(("crs", "x", "y"), PLACES)
def test_coordinates_in_the_area_raise_no_doubt(crs: str, x: float, y: float) -> None:
    assert not [*check_place(crs, np.array([[x, y, 500.0], [x + 1e-4, y, 500.0]]), "the points")]


@pytest.mark.parametrize(("crs", "x", "y"), PLACES)
def test_maps_that_are_not_to_scale_are_doubted(crs: str, x: float, y: float) -> None:
    doubts = [*check_grid_scale(crs, np.array([[x, y, 500.0], [x + 1e-4, y, 500.0]]))]
    assert [doubt.code for doubt in doubts] == [Cause.GRID_SCALE] * (crs == "EPSG:3857")
    exported = [*check_export_crs(crs, np.array([[x, y, 500.0], [x + 1e-4, y, 500.0]]))]
    assert [doubt.code for doubt in exported] == [Cause.GRID_SCALE] * (crs == "EPSG:3857")


@pytest.mark.parametrize(
    ("crs", "x", "y", "outside"),
    [
        ("EPSG:32732", 689586.0, 15336252.0, "48° outside the area of EPSG:32732 (Between 6°E"),
        ("EPSG:3031", 3.4e6, 16.9e6, "outside the area of EPSG:3031 (Antarctica); name"),
    ],
)
def test_points_are_not_exported_to_another_region_unnoticed(
    crs: str, x: float, y: float, outside: str
) -> None:
    (doubt,) = check_export_crs(crs, np.array([[x, y, 500.0]]))
    assert not doubt.is_grave
    assert doubt.code is Cause.CRS
    assert outside in f"{doubt.sentence}; {doubt.remedy}"
    assert doubt.remedy.startswith("name a CRS of this region, for example --crs EPSG:326")


def test_the_scale_of_a_map_is_that_of_mercator_s_projection() -> None:
    """1 / cos of the latitude on the sphere, and a UTM zone for the place."""
    (doubt,) = check_grid_scale("EPSG:3857", np.array([[1285600.0, 6133000.0]]))
    assert doubt.figures["scale"] == pytest.approx(1.0 / np.cos(np.radians(48.15)), rel=0.003)
    assert "stretches horizontal lengths by 50 % here" in doubt.sentence
    assert "EPSG:32632" in doubt.remedy
    assert not doubt.is_grave
    (shrunk,) = check_grid_scale("EPSG:3034", np.array([[4.1e6, 2.4e6]]))
    assert "EPSG:3034 shrinks horizontal lengths by 3." in shrunk.sentence


@pytest.mark.parametrize(("crs", "x", "y"), [PLACES[i] for i in (0, 2, 5, 6, 7, 8)])
def test_exchanged_axes_are_named(crs: str, x: float, y: float) -> None:
    (doubt,) = check_place(crs, np.array([[y, x, 500.0]]), "the trajectory")
    assert doubt.is_grave
    assert doubt.code is Cause.AXES_SWAPPED
    assert "with x and y exchanged it fits" in doubt.sentence


@pytest.mark.parametrize(
    ("crs", "x", "y", "code", "words"),
    [
        ("EPSG:4326", 0.20157, 0.84039, Cause.ANGLE_UNIT, "in radians they would be 48.15"),
        ("EPSG:4258", 0.20157, 0.84039, Cause.ANGLE_UNIT, "in radians they would be 48.15"),
        ("EPSG:25832", 11.549, 48.151, Cause.CRS, "longitude and latitude in degrees"),
        ("EPSG:25832", 48.151, 11.549, Cause.CRS, "latitude and longitude in degrees"),
        ("EPSG:25832", 0.20157, 0.84039, Cause.CRS, "longitude and latitude in radians"),
        ("EPSG:25832", 32689586.0, 5336252.0, Cause.CRS, "begin with a zone number, 32"),
        ("EPSG:4326", 689586.0, 5336252.0, Cause.CRS, "seem to be metres"),
        ("EPSG:27700", 689586.0, 5336252.0, Cause.CRS, "outside the area of EPSG:27700"),
    ],
)
def test_the_probable_reading_of_coordinates_is_named(
    crs: str, x: float, y: float, code: Cause, words: str
) -> None:
    (doubt,) = check_place(crs, np.array([[x, y, 500.0]]), "the trajectory")
    assert doubt.code is code
    assert words in doubt.sentence


def test_a_place_is_described_in_words() -> None:
    assert place_text("EPSG:32719", -70.6, -33.4).startswith(
        "33.4000° S 70.6000° W; EPSG:32719 is for: Between 72°W and 66°W, southern hemisphere"
    )


def test_areas_of_use_may_cross_the_antimeridian() -> None:
    area = area_of_use("EPSG:3832")  # PDC Mercator, the Pacific
    assert area is not None
    assert area.west_deg > area.east_deg
    assert area.degrees_outside(179.0, 0.0) == area.degrees_outside(-179.0, 0.0) == 0.0
    assert area.degrees_outside(0.0, 0.0) > 60.0


def test_points_outside_the_map_are_nan() -> None:
    place = longitude_latitude("EPSG:25832", np.array([[689586.0, 5336252.0], [1e30, 1e30]]))
    assert place[0] == pytest.approx([11.549, 48.151], abs=1e-3)
    assert np.isnan(place[1]).all()


GROUND = np.array([[11.549, 48.151], [11.551, 48.152]])


def header(longitude: float, latitude: float) -> FrameHeader:
    return FrameHeader("a.jpg", longitude_deg=longitude, latitude_deg=latitude)


def test_gps_positions_near_the_trajectory_raise_no_doubt() -> None:
    assert not [*check_camera_position([header(11.555, 48.155)], "EPSG:25832", GROUND, "x")]
    assert not [*check_camera_position([FrameHeader("a.jpg")], "EPSG:25832", GROUND, "x")]


def test_a_flight_across_the_antimeridian_raises_no_doubt() -> None:
    longitudes = (179.9996, 179.9998, -179.9998, -179.9996)
    headers = [header(longitude, -42.0) for longitude in longitudes]
    ground = np.array([[longitude, -42.0, 9.0] for longitude in longitudes])
    assert not [*check_camera_position(headers, "EPSG:4167", ground[:, :2], "the trajectory")]
    assert not [*check_place("EPSG:4167", ground, "the trajectory")]  # New Zealand's own


@pytest.mark.parametrize(
    ("ground", "code", "words"),
    [
        (GROUND + np.array([6.0, 0.0]), Cause.CAMERA_POSITION, "lies 445 km away"),
        (GROUND[:, ::-1], Cause.AXES_SWAPPED, "with longitude and latitude exchanged it fits"),
    ],
)
def test_a_trajectory_far_from_the_frames_gps_is_reported(
    ground: np.ndarray[tuple[int, ...], np.dtype[np.float64]], code: Cause, words: str
) -> None:
    (doubt,) = check_camera_position(
        [header(11.555, 48.155)], "EPSG:4326", ground, "the trajectory"
    )
    assert doubt.code is code
    assert words in doubt.sentence


@pytest.mark.parametrize(
    ("ratio", "code"),
    [(0.5, Cause.DIAMETERS), (2.05, Cause.DIAMETERS), (30.0, Cause.DISTANCE_SCALE)],
)
def test_distances_that_contradict_the_altitude_are_reported(ratio: float, code: Cause) -> None:
    altitude = np.array([40.0, 60.0, 80.0, 95.0])
    (doubt,) = check_altitude(altitude, ratio * altitude)
    assert doubt.code is code
    assert not [*check_altitude(altitude, 1.2 * altitude)]
    assert not [*check_altitude(altitude[:2], ratio * altitude[:2])]
