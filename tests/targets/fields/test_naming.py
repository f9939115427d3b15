"""Discs get their names from the lattice that they form, however the field lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.errors import SettingError
from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.targets.fields.layout import Field, FieldBar, GridKind, Mark
from kgcp.targets.fields.naming import Naming, NamingProblem, SeenDiscs, name_discs

CAMERA = Camera(1600, 1200, 1300.0, 1300.0, 790.0, 610.0, -0.15, 0.05)
SQUARE = Field("s", GridKind.SQUARE, 9, 6, 0.025, 0.012, marks=(Mark(1, 1, 0.012, 0.006),))
PLAIN = Field("p", GridKind.SQUARE, 9, 6, 0.025, 0.012)
SMALL = Field("k", GridKind.SQUARE, 5, 4, 0.025, 0.012)
ASYMMETRIC = Field("a", GridKind.ASYMMETRIC, 4, 11, 0.016, 0.01)
HEXAGONAL = Field("h", GridKind.HEXAGONAL, 14, 8, 0.025, 0.015)
LARGE_CORNER = Field("l", GridKind.SQUARE, 8, 8, 0.02, 0.007, marks=(Mark(0, 7, 0.0105),))


def seen(
    field: Field, turn_deg: float, tilt: tuple[float, float], shift: tuple[float, float]
) -> tuple[SeenDiscs, IndexArray]:
    """What a camera would find of a field, in no order, and which discs these are."""
    middle = field.points_m().mean(axis=0)
    rotation = rotation_about(np.array([*tilt, 0.0])) @ rotation_about(
        np.array([0.0, 0.0, np.radians(turn_deg)])
    )
    centres = (field.points_m() - middle) @ rotation.T + [*shift, 0.3]
    normalised = centres[:, :2] / centres[:, 2:]
    pixels = CAMERA.distort(normalised)
    slopes = CAMERA.distort_jacobian(normalised)
    by_point = np.zeros((len(centres), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / centres[:, 2]
    by_point[:, :, 2] = -normalised / centres[:, 2:]
    flat = slopes @ by_point @ rotation[:, :2] * field.radii_m()[:, None, None]
    u, s, _ = np.linalg.svd(flat)
    stretches = np.einsum("nij,nj,nkj->nik", u, s, u)
    is_in: BoolArray = np.all((pixels > 20) & (pixels < [1580, 1180]), axis=1)
    order = np.random.default_rng(3).permutation(np.flatnonzero(is_in))
    found = SeenDiscs(pixels[order], stretches[order], field.inner_radii_m()[order] > 0.0)
    return found, order


def with_others(found: SeenDiscs, others: int) -> SeenDiscs:
    """Add outlines that are no discs of the field, at the end."""
    rng = np.random.default_rng(5)
    places: FloatArray = rng.uniform([0, 0], [1600, 1200], (others, 2))
    sizes = rng.uniform(2.0, 40.0, others)
    return SeenDiscs(
        np.concatenate((found.centres, places)),
        np.concatenate((found.stretches, sizes[:, None, None] * np.eye(2))),
        np.concatenate((found.is_hollow, np.zeros(others, dtype=bool))),
    )


@pytest.mark.parametrize("field", [SQUARE, ASYMMETRIC, LARGE_CORNER], ids=lambda f: f.name)
@pytest.mark.parametrize("turn_deg", [0.0, 77.0, 130.0, 181.0, 265.0])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.7, 0.0), (-0.4, 0.6)])
def test_every_disc_gets_its_own_name(
    field: Field, turn_deg: float, tilt: tuple[float, float]
) -> None:
    found, truth = seen(field, turn_deg, tilt, (0.0, 0.0))
    naming = name_discs(with_others(found, 25), field)
    assert isinstance(naming, Naming)
    assert not naming.is_symmetric
    assert len(naming.disc) >= len(truth) - 2
    own = naming.disc < len(truth)
    assert own.sum() >= len(truth) - 2
    assert np.array_equal(naming.point[own], truth[naming.disc[own]])


@pytest.mark.parametrize("field", [PLAIN, HEXAGONAL], ids=lambda f: f.name)
@pytest.mark.parametrize("turn_deg", [0.0, 77.0, 130.0, 181.0, 265.0])
def test_a_symmetric_field_is_reported_and_named_upright(field: Field, turn_deg: float) -> None:
    found, truth = seen(field, turn_deg, (0.5, -0.3), (0.0, 0.0))
    naming = name_discs(found, field)
    assert isinstance(naming, Naming)
    assert naming.is_symmetric
    turns = [np.arange(len(truth)), *field.symmetries()]
    assert any(np.array_equal(turn[naming.point], truth[naming.disc]) for turn in turns)
    right = np.corrcoef(field.points_m()[naming.point, 0], found.centres[naming.disc, 0])[0, 1]
    assert right > 0.0


def test_part_of_a_field_is_named_by_its_mark() -> None:
    found, truth = seen(SQUARE, 10.0, (0.3, 0.2), (0.12, 0.06))
    assert 15 < len(truth) < 50
    assert found.is_hollow.any()
    naming = name_discs(found, SQUARE)
    assert isinstance(naming, Naming)
    assert len(naming.disc) > 0.9 * len(truth)
    assert np.array_equal(naming.point, truth[naming.disc])
    assert naming.marks == 1


def test_part_of_a_field_without_its_mark_is_not_guessed() -> None:
    found, truth = seen(SQUARE, 10.0, (0.3, 0.2), (-0.13, -0.09))
    assert 10 < len(truth) < 50
    assert not found.is_hollow.any()
    assert name_discs(found, SQUARE) is NamingProblem.AMBIGUOUS


@pytest.mark.parametrize(("radius_px", "is_named"), [(2.0, False), (2.7, True), (5.0, True)])
def test_a_hole_too_small_to_be_seen_does_not_exclude_a_naming(
    radius_px: float,
    is_named: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    """All but the far corners are in view, and no mark looks hollow: turned, the mark is away."""
    found, truth = seen(SQUARE, 0.0, (0.0, 0.0), (0.0, 0.0))
    turned = SQUARE.points_m()[truth] * [-1.0, -1.0, 1.0] + SQUARE.points_m().max(axis=0)
    mark = SQUARE.points_m()[SQUARE.inner_radii_m() > 0.0]
    is_kept = np.linalg.norm(turned - mark, axis=1) > 0.001
    few = SeenDiscs(
        found.centres[is_kept],
        np.tile(radius_px * np.eye(2), (int(is_kept.sum()), 1, 1)),
        np.zeros(int(is_kept.sum()), dtype=bool),
    )
    naming = name_discs(few, SQUARE)
    if not is_named:
        assert naming is NamingProblem.AMBIGUOUS
        return
    assert isinstance(naming, Naming)
    assert mark.tolist() not in SQUARE.points_m()[naming.point].tolist()


@pytest.mark.parametrize(("diameter_m", "is_mark"), [(0.0128, True), (0.0124, False)])
def test_a_disc_is_a_mark_only_if_its_size_is_clearly_different(
    diameter_m: float,
    is_mark: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    """7 % larger than the others, and 3 %, which blur or light may do."""
    field = Field("m", GridKind.SQUARE, 9, 6, 0.025, 0.012, marks=(Mark(1, 1, diameter_m),))
    found, truth = seen(field, 20.0, (0.1, 0.1), (0.0, 0.0))
    naming = name_discs(found, field)
    if not is_mark:
        assert naming is NamingProblem.AMBIGUOUS
        return
    assert isinstance(naming, Naming)
    assert np.array_equal(naming.point, truth[naming.disc])
    assert naming.marks == 1


def test_a_mark_whose_hole_is_not_seen_does_not_count_as_one() -> None:
    field = Field(
        "m", GridKind.SQUARE, 9, 6, 0.025, 0.012, marks=(Mark(1, 1, 0.012, 0.004), Mark(6, 3, 0.02))
    )
    found, truth = seen(field, 20.0, (0.1, 0.1), (0.0, 0.0))
    for share, marks in ((1.0, 2), (0.05, 1)):
        is_hollow = found.is_hollow & (share == 1.0)
        naming = name_discs(SeenDiscs(found.centres, share * found.stretches, is_hollow), field)
        assert isinstance(naming, Naming)
        assert np.array_equal(naming.point, truth[naming.disc])
        assert len(naming.disc) == 54
        assert naming.marks == marks


def test_the_reason_is_given_if_discs_are_no_field() -> None:
    found, _ = seen(SQUARE, 0.0, (0.0, 0.0), (0.0, 0.0))
    few = SeenDiscs(found.centres[:4], found.stretches[:4], found.is_hollow[:4])
    assert name_discs(few, SQUARE) is NamingProblem.TOO_FEW
    assert name_discs(found, HEXAGONAL) is NamingProblem.NO_LATTICE  # a homography cannot tell
    assert name_discs(found, SMALL) is NamingProblem.NO_LATTICE
    far, _ = seen(SMALL, 0.0, (0.0, 0.0), (-0.08, 0.0))
    near, _ = seen(SMALL, 20.0, (0.0, 0.0), (0.09, 0.02))
    both = SeenDiscs(
        np.concatenate((far.centres, near.centres)),
        np.concatenate((far.stretches, near.stretches)),
        np.concatenate((far.is_hollow, near.is_hollow)),
    )
    assert name_discs(both, SMALL) is NamingProblem.TWO_FIELDS


def test_lattices_are_numbered_as_in_their_programs() -> None:
    asymmetric = ASYMMETRIC.points_m()
    expected = [((2 * i + j % 2) * 0.016, j * 0.016) for j in range(11) for i in range(4)]
    assert np.allclose(asymmetric[:, :2], expected)
    assert len(Field("b", GridKind.HEXAGONAL, 28, 24, 0.012, 0.01).names()) == 336
    spacing = np.linalg.norm(HEXAGONAL.points_m()[:, None] - HEXAGONAL.points_m(), axis=2)
    assert np.sort(spacing, axis=1)[:, 1] == pytest.approx(0.025)
    assert len(PLAIN.symmetries()) == 1
    assert len(Field("q", GridKind.SQUARE, 5, 5, 0.02, 0.01).symmetries()) == 3
    assert SQUARE.symmetries() == []


def bar(first: str, second: str, length_m: float) -> FieldBar:
    return FieldBar(first, second, length_m, 0.0001)


def test_a_distance_may_be_measured_twice() -> None:
    bars = (bar("r0c0", "r0c8", 0.2003), bar("r0c8", "r0c0", 0.1999))
    assert len(replace(SQUARE, columns=9, pitch_m=0.025, bars=bars).bars) == 2


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"pitch_m": 0.012}, "pitch_m"),
        ({"columns": 1}, "columns"),
        ({"diameter_m": -1.0}, "diameter_m"),
        ({"marks": (Mark(9, 0, 0.01),)}, "at"),
        ({"marks": (Mark(1, 0, 0.01), Mark(1, 0, 0.01))}, "at"),
        ({"marks": (Mark(1, 0, 0.01, 0.01),)}, "inner_diameter_m"),
        ({"flat_sd_m": (0.0, 1e-4, 1e-4)}, "flat_sd_m"),
        ({"bars": (bar("r0c0", "r0c8", 0.202), bar("r0c8", "r0c0", 0.198))}, "length_m"),
    ],
)
def test_impossible_fields_are_refused(change: dict[str, object], key: str) -> None:
    values: dict[str, object] = {"columns": 9, "rows": 6, "pitch_m": 0.025, "diameter_m": 0.012}
    with pytest.raises(SettingError) as caught:
        Field("f", GridKind.SQUARE, **(values | change))  # type: ignore[arg-type]  # wrong on purpose
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("kind", "columns", "rows", "is_field"),
    [
        (GridKind.SQUARE, 100, 100, True),
        (GridKind.SQUARE, 101, 100, False),
        (GridKind.HEXAGONAL, 200, 100, True),  # every second place has a disc
        (GridKind.HEXAGONAL, 201, 100, False),
        (GridKind.HEXAGONAL, 3, 3, False),
    ],
)
def test_the_limits_of_a_field_are_those_that_its_refusal_names(
    kind: GridKind,
    columns: int,
    rows: int,
    is_field: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    if is_field:
        assert len(Field("f", kind, columns, rows, 0.025, 0.012).names()) == 10_000
    else:
        with pytest.raises(SettingError, match=f"{columns} x {rows} is not .* 6 to 10000 discs"):
            Field("f", kind, columns, rows, 0.025, 0.012)
