"""Discs of fields without a lattice get their names from codes, or from their arrangement."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import Circles3D, circle_images
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.targets.fields.naming import Naming, NamingProblem, SeenDiscs
from kgcp.targets.fields.point_naming import name_by_codes, name_by_places
from kgcp.targets.fields.points import CodeRing, FieldPoint, PointField

CAMERA = Camera(1600, 1200, 1300.0, 1300.0, 790.0, 610.0, -0.15, 0.05)
RING = CodeRing(8, 2.0, 3.0)


def scattered(count: int = 40, *, y_up: bool = False) -> PointField:
    """A field of discs anywhere on a plane, three of them above it."""
    rng = np.random.default_rng(7)
    places: list[FloatArray] = []
    while len(places) < count:
        place = rng.uniform((-0.2, -0.15), (0.2, 0.15))
        if all(np.linalg.norm(place - other) > 0.03 for other in places):
            places.append(place)
    points = []
    for number, (x, y) in enumerate(places):
        depth = -0.05 if number % 16 == 5 else 0.0
        # seen from where z points to, in the one frame, and from where it comes from, in the other
        position = (x, -y, -depth) if y_up else (x, y, depth)
        points.append(FieldPoint(f"p{number}", position, 0.01))
    return PointField("scattered", tuple(points))


def seen(field: PointField, turn_deg: float, tilt: tuple[float, float]) -> SeenDiscs:
    """What a camera finds of a field, in the field's order; it looks from the front."""
    is_up = field.points_m()[:, 2].max() > 0.0
    upright = np.diag([1.0, -1.0, -1.0]) if is_up else np.eye(3)
    turned = rotation_about(np.array([0.0, 0.0, np.radians(turn_deg)]))
    rotation = rotation_about(np.array([*tilt, 0.0])) @ turned @ upright
    pose = Pose(rotation, np.array([0.01, -0.01, 0.6]))
    centres = pose.transform(field.points_m())
    circles = Circles3D.with_normals(centres, field.normals() @ rotation.T, field.radii_m())
    moments = circle_images(CAMERA, circles).moments
    stretches = []
    for xx, xy, yy in moments[:, 2:].tolist():
        values, vectors = np.linalg.eigh(4.0 * np.array([[xx, xy], [xy, yy]]))
        stretches.append(vectors @ np.diag(np.sqrt(values)) @ vectors.T)
    hollow = np.zeros(len(moments), dtype=bool)
    return SeenDiscs(moments[:, :2], np.array(stretches), hollow)


def shuffled(found: SeenDiscs, others: int) -> tuple[SeenDiscs, IndexArray]:
    """The discs in no order, most of them, with others among them; and which these are."""
    rng = np.random.default_rng(3)
    order = rng.permutation(len(found.centres))[: len(found.centres) - 4]
    places = rng.uniform([0, 0], [1600, 1200], (others, 2))
    sizes = rng.uniform(3.0, 30.0, others)[:, None, None] * np.eye(2)
    mixed = SeenDiscs(
        np.concatenate((found.centres[order], places)),
        np.concatenate((found.stretches[order], sizes)),
        np.zeros(len(order) + others, dtype=bool),
    )
    return mixed, np.concatenate((order, np.full(others, -1)))


@pytest.mark.parametrize("y_up", [False, True])
@pytest.mark.parametrize(
    ("turn_deg", "tilt"), [(0.0, (0.0, 0.0)), (77.0, (0.6, 0.0)), (200.0, (-0.3, 0.5))]
)
def test_every_disc_gets_its_own_name(
    turn_deg: float, tilt: tuple[float, float], *, y_up: bool
) -> None:
    field = scattered(y_up=y_up)
    mixed, truth = shuffled(seen(field, turn_deg, tilt), 15)
    naming = name_by_places(mixed, field)
    assert isinstance(naming, Naming)
    assert not naming.is_symmetric
    assert np.array_equal(truth[naming.disc], naming.point)
    is_flat = field.points_m()[truth[truth >= 0], 2] == 0.0
    assert len(naming.disc) >= np.count_nonzero(is_flat) - 1


def test_a_grid_has_no_names() -> None:
    points = [
        FieldPoint(f"{column}-{row}", (0.04 * column, 0.04 * row, 0.0), 0.01)
        for row in range(5)
        for column in range(5)
    ]
    field = PointField("grid", tuple(points))
    assert name_by_places(seen(field, 20.0, (0.3, 0.1)), field) is NamingProblem.AMBIGUOUS


def test_discs_of_another_field_are_not_named() -> None:
    rng = np.random.default_rng(5)
    centres = rng.uniform([300, 300], [1300, 900], (30, 2))
    other = SeenDiscs(centres, np.tile(12.0 * np.eye(2), (30, 1, 1)), np.zeros(30, dtype=bool))
    assert name_by_places(other, scattered()) is NamingProblem.NO_LATTICE


def test_codes_are_recognised_from_any_starting_sector() -> None:
    codes = (0b00000001, 0b00000011, 0b00000101, 0b00000111, 0b00001011, 0b00010101, 0b00011011)
    points = [
        FieldPoint(f"p{i}", (0.05 * i, 0.04 * (i % 3), 0.0), 0.01, code=code)
        for i, code in enumerate(codes)
    ]
    field = PointField("coded", tuple(points), code=RING)
    turned = [RING.canonical((code << 3 | code >> 5) & 0xFF) for code in codes]
    naming = name_by_codes([None, *reversed(turned), 0b01110111], field, RING)
    assert isinstance(naming, Naming)
    assert dict(zip(naming.disc.tolist(), naming.point.tolist(), strict=True)) == {
        disc: 7 - disc for disc in range(1, 8)
    }
    twice = [*turned, turned[0], turned[1]]
    assert name_by_codes(twice, field, RING) is NamingProblem.TOO_FEW
    assert name_by_codes([*turned, *turned[1:]], field, RING) is NamingProblem.TWO_FIELDS
