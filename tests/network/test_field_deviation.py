"""By how much the discs of a field are off, relative to their stated standard deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import rotation_about
from kgcp.network.calibration_records import NamedView
from kgcp.network.field_deviation import FieldDeviation, field_deviation
from kgcp.targets.fields.layout import FieldBar
from kgcp.targets.fields.points import FieldPoint, PointField

ROUGH, ACCURATE = (1e-3, 1e-3, 1e-3), (5e-5, 5e-5, 5e-5)
RNG = np.random.default_rng(3)
PLACES = RNG.uniform(0.0, 0.4, (20, 3)) + 0.5 * np.indices((5, 4, 1)).reshape(3, 20).T
FIELD = PointField(
    "surveyed",
    tuple(
        FieldPoint(f"n{row}", (x, y, z), 0.02, sd_m=ROUGH if row % 2 else ACCURATE)
        for row, (x, y, z) in enumerate(PLACES.tolist())
    ),
)
OFF = FIELD.point_sds_m() * RNG.standard_normal((20, 3))


def deviation(points_m: FloatArray, field: PointField = FIELD) -> FieldDeviation:
    none = np.zeros((20, 0))
    view = NamedView("p", np.arange(20), none, none, is_symmetric=False)
    return field_deviation(field, [view], points_m)


def test_rough_discs_cast_no_doubt_on_accurate_ones() -> None:
    """Half of the discs are known to 1 mm, the others to 0.05 mm, and all are as stated."""
    found = deviation(PLACES + OFF)
    assert found.doubt == ""
    assert 0.7 < found.in_plane_ratio < 1.3
    assert 0.7 < found.height_ratio < 1.3


def test_one_accurate_disc_that_is_off_is_named() -> None:
    points = PLACES + OFF
    points[4, 0] += 0.002
    found = deviation(points)
    assert found.worst_disc == "n4"
    assert "in its plane" in found.doubt
    assert 0.0015 < found.worst_m < 0.0025


def test_only_a_field_with_a_measured_distance_has_a_scale() -> None:
    turned = 1.001 * (PLACES + OFF) @ rotation_about(np.array((1e-3, 2e-3, -1e-3))).T + 0.01
    assert deviation(turned).doubt == ""
    bar = FieldBar("n0", "n18", float(np.linalg.norm(PLACES[18] - PLACES[0])), 2e-5)
    assert deviation(turned, replace(FIELD, bars=(bar,))).doubt != ""
