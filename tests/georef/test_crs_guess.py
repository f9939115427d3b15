from __future__ import annotations

import pytest

from kgcp.georef.crs_guess import crs_near, utm_crs


@pytest.mark.parametrize(
    ("longitude", "latitude", "crs"),
    [(11.5, 48.1, "EPSG:32632"), (-180.0, -1.0, "EPSG:32701"), (180.0, 1.0, "EPSG:32601")],
)
def test_utm_zones_follow_from_longitude_and_latitude(
    longitude: float, latitude: float, crs: str
) -> None:
    assert utm_crs(longitude, latitude) == crs


def test_guessed_systems_are_those_that_place_a_point_near_the_frames() -> None:
    near = crs_near(689_412.0, 5_336_208.0, 11.549, 48.151)
    assert near[0] == "EPSG:25832"
    assert "EPSG:32632" in near
    assert "EPSG:31468" not in near
    assert "EPSG:31468" in crs_near(4_466_500.0, 5_334_900.0, 11.549, 48.151)
    assert crs_near(0.0, 0.0, 11.549, 48.151) == ()
