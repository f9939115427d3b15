from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kgcp.errors import SettingError
from kgcp.targets.layout import Ring, Target
from kgcp.targets.validation import check_targets, codes_coincide, same_shape

CODE = (0.0, 43.0, 78.0, 180.0)
OTHER_CODE = (10.0, 80.0, 150.0, 250.0, 290.0)


def ring(name: str = "A", code: tuple[float, ...] = CODE, size_m: float = 0.9) -> Ring:
    return Ring(name, size_m, 0.5 * size_m, size_m / 1.4, size_m / 7.0, code)


@given(
    turn_deg=st.floats(-360.0, 360.0),
    jitter_deg=st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4),
)
def test_a_rotated_code_coincides_from_any_starting_dot(
    turn_deg: float, jitter_deg: list[float]
) -> None:
    turned = np.mod(np.add(CODE, jitter_deg) + turn_deg, 360.0)
    assert codes_coincide(ring(), ring("B", tuple(turned.tolist())))


@pytest.mark.parametrize(
    "code", [OTHER_CODE, (0.0, 43.0, 78.0, 220.0), (0.0, 102.0, 137.0, 180.0), (0.0, 43.0, 78.0)]
)
def test_other_and_mirrored_codes_do_not_coincide(code: tuple[float, ...]) -> None:
    assert not codes_coincide(ring(), ring("B", code))


def test_shape_does_not_depend_on_size() -> None:
    assert same_shape(ring(), ring("B", size_m=0.18))
    assert not same_shape(ring(), Ring("B", 0.9, 0.3, 0.6, 0.12, CODE))


@pytest.mark.parametrize(("inner_m", "is_same"), [(0.553, True), (0.559, False)])
def test_comparing_shapes_is_symmetric(inner_m: float, *, is_same: bool) -> None:
    narrow = Ring("A", 1.0, 0.5, 0.72, 0.1, CODE)
    wide = Ring("B", 1.0, inner_m, 0.72, 0.1, CODE)
    assert same_shape(narrow, wide) is same_shape(wide, narrow) is is_same


def test_a_replica_with_the_code_of_its_plate_is_refused() -> None:
    plate = ring()
    turned = tuple(angle + 90.0 for angle in CODE)
    with pytest.raises(SettingError, match=r"'A' and 'A-inner' are rotations of each other"):
        check_targets([Target(plate, (plate.scaled("A-inner", 0.2, turned),))])


def test_equal_codes_on_rings_of_different_shape_are_allowed() -> None:
    check_targets([Target(ring()), Target(Ring("B", 0.9, 0.3, 0.6, 0.12, CODE))])


def test_equal_names_are_refused() -> None:
    with pytest.raises(SettingError, match="'A' is the name of two targets"):
        check_targets([Target(ring()), Target(ring("A", OTHER_CODE))])


def test_replicas_must_nest() -> None:
    plate = ring()
    replicas = (
        plate.scaled("large", 0.4, OTHER_CODE),
        plate.scaled("small", 0.21, (0.0, 60.0, 200.0)),
    )
    with pytest.raises(SettingError, match=r"'small' .0.189 m. does not fit into 'large' .0.18 m"):
        check_targets([Target(plate, replicas)])
