"""Plain targets: valid and impossible ones."""

from __future__ import annotations

import math
from typing import Any

import pytest

from kgcp.errors import SettingError
from kgcp.targets.plain import PlainPolarity, PlainTarget, Shape


def plain(**changes: object) -> PlainTarget:
    values: dict[str, Any] = {
        "name": "W",
        "diameters_m": (0.5,),
        "polarity": PlainPolarity.BRIGHT,
        "position_m": (1.0, 2.0, 3.0),
    }
    return PlainTarget(**(values | changes))


def test_shape_follows_from_its_circles() -> None:
    assert plain().shape is Shape.DISC
    assert plain(diameters_m=(0.5, 0.3, 0.1)).shape is Shape.RING


def test_normal_becomes_a_unit_vector() -> None:
    assert plain(normal_enu=(0.0, -3.0, 4.0)).normal_enu == (0.0, -0.6, 0.8)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"diameters_m": (0.3, 0.5)}, "inner_diameter_m"),
        ({"diameters_m": (0.5, 0.49)}, "inner_diameter_m"),
        ({"diameters_m": tuple(1.0 * 0.8**i for i in range(9))}, "inner_diameter_m"),
        ({"diameters_m": (0.0,)}, "diameter_m"),
        ({"diameters_m": (math.nan,)}, "diameter_m"),
        ({"border_m": 0.0}, "border_m"),
        ({"thickness_m": -0.01}, "thickness_m"),
        ({"sd_normal_deg": 0.0}, "level_sd_deg"),
        ({"normal_enu": (0.0, 0.0, 0.0)}, "normal"),
        ({"sd_diameter_m": -0.1}, "sd_diameter_m"),
    ],
)
def test_impossible_targets_are_refused(changes: dict[str, Any], key: str) -> None:
    with pytest.raises(SettingError) as caught:
        plain(**changes)
    assert caught.value.key == key
