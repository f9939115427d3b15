"""Unusual and random photographs raise no exception and give finite results."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc, Operator

_ROWS, _COLUMNS = np.mgrid[0:90, 0:120]
PHOTOS: dict[str, GreyArray] = {
    "one pixel": np.zeros((1, 1), np.uint8),
    "nothing": np.zeros((0, 7), np.uint8),
    "a line": np.zeros((3, 300), np.uint8),
    "even": np.full((60, 60), 255, np.uint8),
    "noise": np.random.default_rng(0).integers(0, 256, (90, 120)).astype(np.uint8),
    "deep noise": np.random.default_rng(0).integers(0, 65536, (90, 120)).astype(np.uint16),
    "floats": np.random.default_rng(0).uniform(0.0, 1.0, (90, 120)),
    "blocks": np.kron(np.random.default_rng(1).integers(0, 256, (18, 24)), np.ones((5, 5))).astype(
        np.uint8
    ),
    "circles": (np.hypot(_COLUMNS - 60, _ROWS - 45) % 14 < 7).astype(np.uint8) * 255,
}


@pytest.mark.parametrize("name", PHOTOS)
def test_unusual_photographs_give_finite_results(name: str) -> None:
    photo = PHOTOS[name]
    outlines = find_outlines(photo)
    assert (len(outlines) > 0) is (name == "circles")
    for operator in Operator:
        for disc in measure_discs(photo, outlines, operator=operator):
            if isinstance(disc, Disc):
                assert np.isfinite(disc.vector).all()
                assert np.linalg.eigvalsh(disc.cov)[0] > 0.0


@st.composite
def photographs(draw: st.DrawFn) -> GreyArray:
    """Draw small photographs: noise, checkers, stripes, and ellipses cut by the border."""
    height, width = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    rows, columns = np.mgrid[0:height, 0:width]
    period = draw(st.integers(1, 9))
    checkers = (rows // period + columns // period * draw(st.integers(0, 1))) % 2
    a, b = draw(st.floats(1.0, 20.0)), draw(st.floats(1.0, 20.0))
    x, y = draw(st.floats(-3.0, 43.0)), draw(st.floats(-3.0, 43.0))
    ellipse = 0.5 - 0.5 * np.tanh(2.0 * (np.hypot((columns - x) / a, (rows - y) / b) - 1.0) * a)
    share = draw(st.sampled_from((checkers, ellipse, 1.0 - ellipse, rng.uniform(size=rows.shape))))
    levels = share * draw(st.floats(0.0, 1.6)) + draw(st.floats(0.0, 0.1))
    levels = levels + draw(st.sampled_from((0.0, 0.01, 0.1))) * rng.standard_normal(rows.shape)
    white, kind = draw(st.sampled_from(((255, "uint8"), (65535, "uint16"))))
    photo: GreyArray = np.rint(np.clip(levels, 0.0, 1.0) * white).astype(kind)
    return photo


@settings(max_examples=25, deadline=None)
@given(photographs(), st.sampled_from(Response), st.sampled_from(Operator))
def test_random_photographs_give_finite_results(
    photo: GreyArray, response: Response, operator: Operator
) -> None:
    outlines = find_outlines(photo)
    for disc in measure_discs(photo, outlines, response=response, operator=operator):
        if isinstance(disc, Disc):
            assert np.isfinite(disc.vector).all()
            assert np.linalg.eigvalsh(disc.cov)[0] > 0.0


def test_read_only_and_16_bit_photographs_give_the_same_results(sharp: GreyArray) -> None:
    shallow = find_outlines(sharp)
    sharp.flags.writeable = False
    assert find_outlines(sharp) == shallow
    for factor in (257, 16, 4, 2):  # of 16, 12, 10 and 9 bits
        deep = find_outlines(sharp.astype(np.uint16) * factor)
        assert len(deep) == len(shallow) == 1
        assert deep[0].ellipse.x == pytest.approx(shallow[0].ellipse.x, abs=1e-6)
        white = 200.0 / 255.0  # the brightest pixels of the deep one
        assert deep[0].contrast == pytest.approx(shallow[0].contrast / white, rel=1e-6)


@pytest.fixture
def sharp() -> GreyArray:
    disc = np.clip(np.hypot(_COLUMNS - 60.3, _ROWS - 44.6) - 15.0, -0.5, 0.5) + 0.5
    levels: GreyArray = (20.0 + 180.0 * disc).astype(np.uint8)
    return levels
