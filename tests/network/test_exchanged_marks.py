"""Marks with exchanged names are found on ground that is not flat."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import rotation_about
from kgcp.georef.plain_prediction import MarkedPlace
from kgcp.georef.target_positions import TargetPosition
from kgcp.network.ground.exchanged_marks import exchanged_marks

CAMERA = Camera(4000, 3000, 3000.0, 3000.0, 2000.0, 1500.0)
HEIGHT_M, RELIEF_M, NOISE_PX = 30.0, 5.0, 1.0


def marked_frame(
    rng: np.random.Generator, count: int, tilt_deg: float
) -> tuple[dict[str, MarkedPlace], dict[str, TargetPosition]]:
    """Marks, good to a pixel, of targets of any height in a tilted frame."""
    tilt = rotation_about(np.array([math.radians(tilt_deg), 0.0, 0.0]))
    enu_from_camera = np.diag((1.0, -1.0, -1.0)) @ tilt
    pixels = rng.uniform((50.0, 50.0), (CAMERA.width - 50.0, CAMERA.height - 50.0), (count, 2))
    rays = np.column_stack((CAMERA.undistort(pixels), np.ones(count))) @ enu_from_camera.T
    depths = (rng.uniform(-RELIEF_M, RELIEF_M, count) - HEIGHT_M) / rays[:, 2]
    positions = rays * depths[:, None] + (0.0, 0.0, HEIGHT_M)
    marks = pixels + NOISE_PX * rng.standard_normal((count, 2))
    names = [f"T{number}" for number in range(count)]
    return (
        {name: MarkedPlace(x, y, 2.0) for name, (x, y) in zip(names, marks, strict=True)},
        {name: TargetPosition(place, None) for name, place in zip(names, positions, strict=True)},
    )


@pytest.mark.parametrize(("count", "least", "trials"), [(3, 0.7, 60), (4, 0.95, 20)])
@pytest.mark.parametrize("tilt_deg", [5.0, 30.0])
def test_exchanged_marks_are_found_and_right_ones_are_not(
    count: int, least: float, trials: int, tilt_deg: float
) -> None:
    rng = np.random.default_rng(5)
    named = 0
    for _ in range(trials):
        marks, positions = marked_frame(rng, count, tilt_deg)
        assert exchanged_marks(marks, positions, CAMERA) is None
        exchanged = {**marks, "T0": marks["T2"], "T2": marks["T0"]}
        named += exchanged_marks(exchanged, positions, CAMERA) == ("T0", "T2")
    assert least * trials <= named <= trials


@pytest.mark.parametrize(("count", "length"), [(4, 3), (4, 4), (5, 5), (8, 4), (15, 4)])
def test_names_that_are_exchanged_in_a_cycle_are_found(count: int, length: int) -> None:
    """Each of some targets has the mark of the one before, as if counted from the wrong one."""
    rng = np.random.default_rng(7)
    for _ in range(2):
        marks, positions = marked_frame(rng, count, 10.0)
        names = [*marks][:length]
        exchanged = {**marks, **{name: marks[names[at - 1]] for at, name in enumerate(names)}}
        assert exchanged_marks(exchanged, positions, CAMERA) == tuple(names)


def test_two_marks_cannot_show_an_exchange() -> None:
    marks, positions = marked_frame(np.random.default_rng(5), 2, 5.0)
    assert exchanged_marks(marks, positions, CAMERA) is None


def test_three_marks_in_a_line_cannot_show_an_exchange() -> None:
    places = {f"T{at}": TargetPosition(np.array([4.0 * at, 0.0, 0.0]), None) for at in range(3)}
    marks = {f"T{at}": MarkedPlace(1000.0 + 500.0 * at, 1500.0, 2.0) for at in (1, 0, 2)}
    assert exchanged_marks(marks, places, CAMERA) is None
