"""Wrong names are noticed by holes where there are none, mirrored boards and places."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.calibrate.order import Order, order_of
from kgcp.geometry.arrays import GreyArray
from kgcp.network.calibration_records import CameraCalibration
from tests.quality.test_calibration_verdict import FIELD, calibrated, views

INSIDE, OUTSIDE = 0.1, 0.8


def drawn(calibration: CameraCalibration) -> dict[str, GreyArray]:
    """Photographs with the middles of discs only: of the mark, the hole."""
    greys = {}
    for view in calibration.views:
        grey = np.full((1200, 1600), round(255 * OUTSIDE), np.uint8)
        for point, (x, y) in zip(view.point.tolist(), view.vectors[:, :2].tolist(), strict=True):
            if FIELD.inner_radii_m()[point] == 0.0:
                cv2.circle(grey, (round(x), round(y)), 4, round(255 * INSIDE), -1)
        greys[view.photo] = grey
    return greys


def order(calibration: CameraCalibration, greys: dict[str, GreyArray]) -> Order:
    appearance = np.tile([INSIDE, OUTSIDE, 0.7, 0.0, 1.0], (len(FIELD.discs()), 1))
    seen = SimpleNamespace(appearance=appearance)
    made: Any = SimpleNamespace(
        calibration=calibration, discs={view.photo: seen for view in calibration.views}
    )
    return order_of(made, greys)


@pytest.fixture(scope="module")
def right() -> CameraCalibration:
    return calibrated(views())


def with_pose(
    calibration: CameraCalibration, turn: list[float], names: list[int], *, add: float
) -> CameraCalibration:
    """The first photograph with other names, and the pose that goes with them."""
    estimate, first = calibration.solution.estimate, calibration.views[0]
    rotations, translations = estimate.rotations.copy(), estimate.translations.copy()
    middle = np.array([1.0, 1.0, 0.0]) * estimate.points.mean(axis=0)
    translations[0] += add * rotations[0] @ middle
    rotations[0] = rotations[0] @ np.diag(turn)
    moved = replace(estimate, rotations=rotations, translations=translations)
    named = replace(first, point=np.array(names))
    return replace(
        calibration,
        views=(named, *calibration.views[1:]),
        solution=replace(calibration.solution, estimate=moved),
    )


def test_right_names_are_right(right: CameraCalibration) -> None:
    found = order(right, drawn(right))
    assert found.wrong == ()
    assert (found.photographs, found.discs, found.marks) == (6, 180, 6)
    assert 0.0 < found.farthest < 0.01


def test_a_turned_board_has_its_mark_where_there_is_none(right: CameraCalibration) -> None:
    turned = with_pose(right, [-1.0, -1.0, 1.0], list(range(30))[::-1], add=2.0)
    found = order(turned, drawn(right))
    assert found.wrong == ("p0",)
    assert found.farthest < 0.01


def test_neighbours_that_are_exchanged_are_off_their_places(right: CameraCalibration) -> None:
    names = [1, 0, *range(2, 30)]
    found = order(with_pose(right, [1.0, 1.0, 1.0], names, add=0.0), drawn(right))
    assert found.wrong == ("p0",)
    assert 0.8 < found.farthest < 1.5
