"""Codes are read from the sectors around a disc, however it is tilted, turned and lit."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.discs.code_rings import read_codes
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import DiscOutline
from kgcp.simulation.disc_field import DiscCode, FieldScene, SimulatedDisc, photograph
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.targets.fields.points import CodeRing

CAMERA = Camera(120, 120, 300.0, 300.0, 59.5, 59.5)
RING = CodeRing(12, 2.1, 3.1)
CODE = 0b000001011011


def coded_disc(
    turn: float, tilt: tuple[float, float], *, code: int | None = CODE, is_bright: bool = False
) -> list[tuple[np.ndarray, DiscOutline]]:
    """A photograph of one disc with a code, and the outlines of the disc's size in it."""
    sectors = tuple(digit == "1" for digit in f"{code:012b}") if code is not None else ()
    ring = DiscCode(0.021, 0.031, sectors) if code is not None else None
    disc = SimulatedDisc((0.0, 0.0, 0.0), 0.01, code=ring)
    scene = FieldScene((disc,), *((0.06, 0.7) if is_bright else (0.8, 0.06)), (0.003, -0.002))
    rotation = rotation_about(np.array([*tilt, 0.0])) @ rotation_about(np.array([0.0, 0.0, turn]))
    pose = Pose(rotation, np.array([0.0, 0.0, 0.12]))
    grey = photograph(CAMERA, pose, scene, Optics(0.7), Sensor(), np.random.default_rng(1))
    middle = [
        each
        for each in find_outlines(grey)
        if np.hypot(each.ellipse.x - 59.5, each.ellipse.y - 59.5) < 3.0
        and 6.0 < each.ellipse.mean_radius < 14.0
    ]
    return [(grey, each) for each in middle]


@pytest.mark.parametrize("is_bright", [False, True])
@pytest.mark.parametrize(
    ("turn", "tilt"), [(0.0, (0.0, 0.0)), (1.0, (0.7, 0.2)), (4.0, (0.0, -0.8))]
)
def test_the_code_is_read(turn: float, tilt: tuple[float, float], *, is_bright: bool) -> None:
    ((grey, outline),) = coded_disc(turn, tilt, is_bright=is_bright)
    assert read_codes(grey, [outline], RING) == [RING.canonical(CODE)]
    for factor in (257, 4):  # of 16 and of 10 bits
        wide = grey.astype(np.uint16) * factor
        assert read_codes(wide, [outline], RING) == [RING.canonical(CODE)]


def test_a_disc_without_code_has_none() -> None:
    ((grey, outline),) = coded_disc(0.3, (0.2, 0.2), code=None)
    assert read_codes(grey, [outline], RING) == [None]


def test_a_ring_that_leaves_the_photograph_is_not_read() -> None:
    ((grey, outline),) = coded_disc(0.0, (0.0, 0.0))
    assert read_codes(grey[:, 30:], [outline], RING) == [None]
