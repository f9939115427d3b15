"""Fields of points: valid and impossible ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from kgcp.errors import SettingError
from kgcp.targets.fields.layout import FieldBar
from kgcp.targets.fields.points import CodeRing, FieldPoint, PointField, gaps_between

POINTS = tuple(
    FieldPoint(f"p{i}", (0.05 * (i % 3), 0.04 * (i // 3), 0.01 * (i % 2)), 0.02) for i in range(6)
)
RING = CodeRing(10, 2.0, 3.0)


def changed(**values: Any) -> tuple[FieldPoint, ...]:  # noqa: ANN401 - any field of a point
    return (replace(POINTS[0], **values), *POINTS[1:])


def coded(*codes: int | None) -> tuple[FieldPoint, ...]:
    """All points, small enough for codes around them."""
    return tuple(
        replace(p, diameter_m=0.01, code=code) for p, code in zip(POINTS, codes, strict=True)
    )


def test_a_field_gives_the_properties_of_its_discs() -> None:
    own = replace(POINTS[2], sd_m=(1e-6, 2e-6, 3e-6))
    field = PointField("f", (*POINTS[:2], own, *POINTS[3:]), flat_sd_m=(1e-4, 1e-4, 2e-4))
    assert field.names() == ("p0", "p1", "p2", "p3", "p4", "p5")
    assert field.point_sds_m()[1:3].tolist() == [[1e-4, 1e-4, 2e-4], [1e-6, 2e-6, 3e-6]]
    assert field.pitch_m == pytest.approx(np.hypot(0.04, 0.01))
    assert field.with_diameters(1.5).radii_m() == pytest.approx([0.015] * 6)
    assert gaps_between(field.points_m())[0, :2] == pytest.approx([np.inf, np.hypot(0.05, 0.01)])


def test_codes_are_stored_as_the_smallest_of_their_rotations() -> None:
    assert RING.canonical(0b1100000000) == 0b11
    assert RING.canonical(0b1000000101) == 0b1011
    assert PointField("f", coded(0b1100000000, 5, 7, 9, 11, 13), code=RING).named_by == "code"


def test_code_rings_may_be_closer_on_different_faces() -> None:
    points = coded(3, 5, 7, 9, 11, 13)
    upright = tuple(replace(point, normal=(0.0, 1.0, 0.0)) for point in points[:3])
    ring = CodeRing(10, 2.0, 5.0)
    assert PointField("f", (*upright, *points[3:]), code=ring).code == ring


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"points": POINTS[:5]}, "5 is not a field of 6 to 2000 discs"),
        ({"points": (*POINTS, POINTS[0])}, "p0 stands 2 times"),
        ({"points": changed(diameter_m=0.09)}, "p0 and p3 overlap"),
        (  # which are not the nearest two
            {"points": (*changed(diameter_m=0.1), FieldPoint("near", (0.1, 0.075, 0.01), 0.002))},
            "p0 and p3 overlap",
        ),
        (
            {"points": coded(3, 5, 7, 9, 11, 13), "code": CodeRing(10, 2.0, 5.0)},
            "p0 and p3 overlap",
        ),
        ({"points": changed(diameter_m=0.0)}, "diameter_m of p0: 0 m is out of range"),
        ({"points": changed(inner_diameter_m=0.02)}, "is not inside a disc"),
        ({"points": changed(normal=(0.0, 0.0, 2.0))}, "normal of p0: is not of length 1"),
        ({"points": changed(position_m=(0.0, 0.0, 1e9))}, "of p0 is out of range"),
        ({"points": changed(sd_m=(0.0, 1e-4, 1e-4))}, "sd of p0"),
        ({"points": changed(code=3)}, "is missing, and discs have codes"),
        ({"points": changed(code=1023), "code": RING}, "1023 is not of 10 bits"),
        ({"points": coded(6, 5, 7, 9, 11, 3), "code": RING}, "3 stands 2 times"),
        ({"code": RING}, "0 of the discs have one, and names need 6"),
        ({"points": coded(3, 5, 7, 9, 11, None), "code": RING}, "5 of the discs have one"),
        (
            {
                "points": tuple(
                    replace(p, position_m=(0.05 * i, 0.0, 0.0)) for i, p in enumerate(POINTS)
                )
            },
            "lie in one row",
        ),
        ({"bars": (FieldBar("p0", "p9", 0.1, 1e-5),)}, "'p9' is not a disc"),
        (
            {"bars": (FieldBar("p0", "p1", 0.7, 1e-5),)},
            "0.7 m, but p0 and p1 are 0.0[0-9]+ m apart",
        ),
        (
            {"points": changed(diameter_m=13.0)},
            "13 m is out of range; give metres: 13 mm are 0.013",
        ),
        ({"flat_sd_m": (0.0, 1e-4, 1e-4)}, "flat_sd_m"),
    ],
)
def test_impossible_fields_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        PointField(**{"name": "f", "points": POINTS, **values})


@pytest.mark.parametrize("ring", [(5, 2.0, 3.0), (10, 1.1, 3.0), (10, 2.0, 2.1), (10, 2.0, 11.0)])
def test_impossible_code_rings_are_refused(ring: tuple[int, float, float]) -> None:
    bits, inner, outer = ring
    with pytest.raises(SettingError):
        CodeRing(bits, inner, outer)
