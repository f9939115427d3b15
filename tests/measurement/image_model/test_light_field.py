"""Levels that vary over a window: splines on grids of knots, and what shadows add."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.light_field import LightField, lay_knots
from kgcp.measurement.image_model.photometry import Light, light_after_step
from kgcp.measurement.image_model.shadow_edges import NO_EDGES, ShadowEdges

_SPACING_PX = 8.0
CENTRE_PX = np.array([132.0, 224.0])


def _field(
    columns: int = 64, rows: int = 48, spacings_px: tuple[float, ...] = (_SPACING_PX,)
) -> LightField:
    last_px = 99.0 + columns, 199.0 + rows
    knots = lay_knots((100.0, last_px[0]), (200.0, last_px[1]), CENTRE_PX, spacings_px)
    count = sum(knots.counts)
    return LightField(
        knots,
        np.zeros((2, count)),
        np.ones((2, count)),
        np.zeros(2),
        NO_EDGES,
        CENTRE_PX,
    )


def _pixels() -> FloatArray:
    return np.random.default_rng(1).uniform((100.0, 200.0), (163.0, 247.0), (500, 2)).T


def test_weights_add_up_to_one_everywhere() -> None:
    _, weights = _field().knots.weights(_pixels())
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12
    assert weights.min() >= 0.0


def test_weights_are_those_of_quadratic_b_splines() -> None:
    field, pixels = _field(), _pixels()
    knots, weights = field.knots.weights(pixels)
    dense = np.zeros((pixels.shape[1], sum(field.knots.counts)))
    np.put_along_axis(dense, knots, weights, axis=1)
    along = [
        np.stack(
            [
                BSpline.basis_element(_SPACING_PX * np.arange(k - 2, k + 2), extrapolate=False)(at)
                for k in range(count)
            ]
        )
        for at, count in zip(
            pixels - np.array([field.knots.x0_px, field.knots.y0_px]),
            (field.knots.columns[0], field.knots.rows[0]),
            strict=True,
        )
    ]
    columns, rows = (np.nan_to_num(each) for each in along)
    expected = np.einsum("rn,cn->nrc", rows, columns).reshape(len(dense), -1)
    assert np.abs(dense - expected).max() < 1e-12


@given(
    first_px=st.tuples(st.integers(0, 30), st.integers(0, 30)),
    size_px=st.tuples(st.integers(20, 90), st.integers(20, 90)),
    spacing_px=st.floats(4.0, 40.0),
)
def test_cells_cover_the_window_with_the_centre_in_the_middle_of_one(
    first_px: tuple[int, int], size_px: tuple[int, int], spacing_px: float
) -> None:
    (x, y), (width, height) = first_px, size_px
    centre_px = np.array([x + 0.37 * width, y + 0.58 * height])
    knots = lay_knots((x, x + width - 1), (y, y + height - 1), centre_px, (spacing_px,))
    for begin, cells, first, size, centre in zip(
        (knots.x0_px[0], knots.y0_px[0]),
        (knots.columns[0] - 2, knots.rows[0] - 2),
        first_px,
        size_px,
        centre_px,
        strict=True,
    ):
        assert begin <= first - 0.5 < begin + spacing_px * (1.0 + 1e-9)
        end = begin + cells * spacing_px
        assert end - spacing_px * (1.0 + 1e-9) < first + size - 0.5 <= end + 1e-9
        assert ((centre - begin) / spacing_px) % 1.0 == pytest.approx(0.5, abs=1e-6)


def test_offsets_add_to_the_levels_everywhere_and_have_a_weak_prior() -> None:
    field, pixels = _field(), _pixels()
    field = replace(field, values=np.random.default_rng(3).normal(size=field.values.shape))
    nothing, offsets = np.zeros_like(field.values), np.array([0.1, -0.3])
    moved = field.moved(nothing, offsets, np.empty((0, 5)), np.add)
    (added, gradient), (before, gradient_before) = (
        each.added_with_gradient(pixels) for each in (moved, field)
    )
    assert added - before == pytest.approx(np.repeat([[0.1], [-0.3]], pixels.shape[1], axis=1))
    assert gradient == pytest.approx(gradient_before)
    assert moved.penalty - field.penalty == pytest.approx(0.5 * (0.1**2 + 0.3**2) / 0.5**2)


def test_a_slope_of_the_knots_is_a_slope_of_the_field() -> None:
    field, pixels = _field(), _pixels()
    columns, rows = field.knots.columns[0], field.knots.rows[0]
    slope = np.tile(0.01 * _SPACING_PX * np.arange(columns), rows)
    added = replace(field, values=np.stack((slope, -slope))).added(pixels)
    along = np.polyfit(pixels[0], added[0], 1)
    assert along[0] == pytest.approx(0.01, rel=1e-9)
    assert np.abs(added[0] - np.polyval(along, pixels[0])).max() < 1e-12
    assert np.abs(added[0] + added[1]).max() < 1e-12


def test_gradient_of_the_contrast_is_that_of_what_is_added() -> None:
    rng = np.random.default_rng(5)
    field = _field()
    spacings_px = 2.5 * _SPACING_PX, _SPACING_PX
    coarse = lay_knots((100.0, 163.0), (200.0, 247.0), CENTRE_PX, spacings_px)
    field = replace(
        field,
        knots=coarse,
        values=rng.normal(0.0, 0.2, (2, sum(coarse.counts))),
        shadows=ShadowEdges(np.array([[0.7, 3.0, 0.9, -0.05, -0.5]]), 1),
    )
    pixels = np.array([[100.0], [200.0]]) + rng.uniform(2.0, 40.0, (2, 50))
    step, by_steps = 1e-4, np.empty((2, 50))
    for axis, towards in enumerate(np.eye(2)[:, :, None]):
        change = field.added(pixels + step * towards) - field.added(pixels - step * towards)
        by_steps[axis] = (change[1] - change[0]) / (2.0 * step)
    np.testing.assert_allclose(field.added_with_gradient(pixels)[1], by_steps, rtol=0, atol=1e-7)


@pytest.mark.parametrize("spacings_px", [(_SPACING_PX,), (3.0 * _SPACING_PX, _SPACING_PX)])
@pytest.mark.parametrize("edges", [0, 1])
def test_steps_follow_levels_of_another_scale_everywhere(
    edges: int, spacings_px: tuple[float, ...]
) -> None:
    """If only ink and plate change, the added light of all kinds changes in proportion."""
    rng = np.random.default_rng(5)
    edge = np.array([[0.4, 3.0, 0.7, -0.1, -0.4]])[:edges]
    field, pixels = _field(spacings_px=spacings_px), _pixels()
    shape = field.values.shape
    field = replace(field, values=0.1 * rng.normal(size=shape), offsets=np.array([0.1, -0.2]))
    field = replace(field, shadows=ShadowEdges(edge, edges))
    before, after = Light(0.1, 0.7), Light(0.15, 0.9)

    def light_after(light: FloatArray, step: FloatArray) -> FloatArray:
        moved = light_after_step(light.ravel(), step.ravel(), before.values, after.values)
        return moved.reshape(light.shape)

    values, offsets = 0.05 * rng.normal(size=shape), np.array([-0.1, 0.2])
    change = np.zeros_like(edge)
    change[:, 3:] = 0.1
    step = replace(field, values=field.values + values, offsets=field.offsets + offsets)
    step = replace(step, shadows=ShadowEdges(edge + change, edges))
    base = np.array([[0.0], [1.0]])
    light = base + field.added(pixels)
    expected = light_after(light, base + step.added(pixels) - light)
    moved = field.moved(values, offsets, change, light_after)
    np.testing.assert_allclose(base + moved.added(pixels), expected, atol=1e-12)
    # the same levels to first order, at the new scale
    levels = before.black + (before.white - before.black) * light
    levels += (before.white - before.black) * (base + step.added(pixels) - light)
    levels += (1.0 - light) * (after.black - before.black) + light * (after.white - before.white)
    seen = after.black + (after.white - after.black) * expected
    np.testing.assert_allclose(seen, levels, atol=1e-12)
