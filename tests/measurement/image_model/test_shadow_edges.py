"""Straight edges of shadows: what they add to the levels, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.shadow_edges import NO_EDGES, ShadowEdges

# two shades with one edge, and the sides of a strip across both
ROWS = np.array(
    [
        [0.9, 1.0, 1.0, -0.02, -0.30],
        [2.5, -10.0, 0.7, -0.03, -0.40],
        [2.4, 5.0, 1.2, -0.02, -0.31],
        [2.45, 15.0, 0.9, 0.02, 0.30],
    ]
)


@pytest.fixture(scope="module")
def offsets() -> FloatArray:
    return np.random.default_rng(1).uniform(-30.0, 30.0, (2, 300))


def test_a_shadow_is_half_as_deep_at_its_edge_and_whole_beyond() -> None:
    edge = ShadowEdges(np.array([[0.0, 5.0, np.log(2.0), -0.03, -0.5]]), 1)
    added, _ = edge.added_with_gradient(np.array([[5.0, 28.0, -22.0], [0.0, 6.0, -9.0]]))
    assert added[1] == pytest.approx([-0.25, -0.5, 0.0], abs=1e-6)
    assert added[0] == pytest.approx([-0.015, -0.03, 0.0], abs=1e-6)


def test_a_shadow_within_another_has_no_effect() -> None:
    """An antenna's shadow takes light outside the shade of a building, and none within it."""
    upright = [0.0, 5.0, 0.0, -0.03, -0.5]
    strip = [[1.57, -2.0, 0.0, -0.03, -0.5], [1.57, 2.0, 0.0, 0.03, 0.5]]
    places = np.array([[-20.0, -20.0, 20.0, 20.0], [9.0, 0.0, 9.0, 0.0]])
    added, _ = ShadowEdges(np.array([upright, *strip]), 1).added_with_gradient(places)
    assert added[1] == pytest.approx([0.0, -0.48, -0.5, -0.5], abs=0.01)
    assert ShadowEdges(np.array([upright, *strip]), 1).sunlit_share(places) == pytest.approx(
        [1, 1, 0, 0]
    )
    both, _ = ShadowEdges(np.array([upright, strip[0]]), 2).added_with_gradient(places)
    assert both[1] == pytest.approx([-0.5, -0.49, -0.5, -0.5], abs=0.01)


@pytest.mark.parametrize("single_count", [0, 1, 2])
def test_shadow_edge_derivatives_equal_finite_differences(
    offsets: FloatArray, single_count: int
) -> None:
    edges = ShadowEdges(ROWS, single_count)
    by_level, step = np.random.default_rng(2).normal(size=offsets.shape), 1e-6
    derivatives = edges.derivatives(offsets, by_level).reshape(4, 5, -1)
    for place in np.ndindex(ROWS.shape):
        added = []
        for sign in (1.0, -1.0):
            rows = ROWS.copy()
            rows[place] += sign * step
            added.append(replace(edges, rows=rows).added_with_gradient(offsets)[0])
        slope = np.sum(by_level * (added[0] - added[1]), axis=0) / (2.0 * step)
        assert np.abs(derivatives[place] - slope).max() < 1e-7


@pytest.mark.parametrize("single_count", [0, 1, 2])
def test_the_gradient_is_that_of_the_contrast(offsets: FloatArray, single_count: int) -> None:
    edges, step = ShadowEdges(ROWS, single_count), 1e-5
    _, gradient = edges.added_with_gradient(offsets)
    for axis, towards in enumerate(np.eye(2)[:, :, None]):
        more, less = (
            edges.added_with_gradient(offsets + sign * step * towards)[0] for sign in (1.0, -1.0)
        )
        by_steps = ((more - less)[1] - (more - less)[0]) / (2.0 * step)
        assert np.abs(gradient[axis] - by_steps).max() < 1e-8


def test_far_beyond_a_shade_derivatives_are_finite() -> None:
    far = np.array([[500.0, -500.0], [500.0, -500.0]])
    assert np.isfinite(ShadowEdges(ROWS, 2).derivatives(far, np.ones((2, 2)))).all()


def test_without_edges_nothing_is_added(offsets: FloatArray) -> None:
    added, gradient = NO_EDGES.added_with_gradient(offsets)
    assert not added.any()
    assert not gradient.any()
    assert NO_EDGES.sunlit_share(offsets).min() == 1.0
    assert NO_EDGES.penalty == 0.0
