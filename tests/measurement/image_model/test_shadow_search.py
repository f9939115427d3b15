"""Edges of shadows found on the flat parts of a plate."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import ndtr

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.shadow_search import (
    _BORDERS,
    _DIRECTIONS,
    _MIN_PIXELS,
    _STRIP_FACTOR,
    FoundShadows,
    PlateauPixels,
    _best_step,
    find_shadows,
)

RADIUS_PX, NOISE, HIGH = 45.0, 0.004, 0.998
EDGE = [0.9, 4.0, 0.8]
STRIP = [[2.5, 8.0, 0.3], [2.5, 16.0, 0.3]]


def flat_under(
    edges: list[list[float]],
    strip: list[list[float]],
    ink: float = 0.08,
    plate: float = 0.75,
    left: float = 0.5,
) -> PlateauPixels:
    """Return plate within half of the radius and ink around it.

    Shades beyond edges, and one along a strip, leave the same share of both.
    """
    rng = np.random.default_rng(3)
    y, x = np.mgrid[-RADIUS_PX:RADIUS_PX, -RADIUS_PX:RADIUS_PX] + 0.3
    offsets = np.stack((x[np.hypot(x, y) < RADIUS_PX], y[np.hypot(x, y) < RADIUS_PX]))
    kind = (np.hypot(*offsets) < 0.5 * RADIUS_PX).astype(np.intp)
    sun = np.prod([1.0 - beyond(line, offsets) for line in edges], axis=0)
    if strip:
        near, far = (beyond(line, offsets) for line in strip)
        sun = sun * (1.0 - (near - far))
    light = left + (1.0 - left) * sun
    levels = np.where(kind, plate, ink) * light + NOISE * rng.standard_normal(len(kind))
    return PlateauPixels(offsets, kind, np.clip(levels, 0.0, 1.0), HIGH)


def beyond(line: list[float], offsets: FloatArray) -> FloatArray:
    """Return Φ(distance / penumbra) of an edge at places (2, n)."""
    angle, offset_px, log_width = line
    along_px = math.cos(angle) * offsets[0] + math.sin(angle) * offsets[1]
    return np.asarray(ndtr((along_px - offset_px) / math.exp(log_width)))


def lines_of(seen: FoundShadows) -> FloatArray:
    lines = seen.edges.rows[:, :2].copy()
    lines[:, 0] %= 2.0 * math.pi
    return lines


def test_even_light_has_no_shadows() -> None:
    assert find_shadows(flat_under([], []), Tone.LINEAR) == []


def test_a_single_edge_is_found_with_its_shade() -> None:
    (seen,) = find_shadows(flat_under([EDGE], []), Tone.LINEAR)
    assert seen.edges.single_count == 1
    assert lines_of(seen)[0] == pytest.approx(EDGE[:2], abs=0.2)
    assert seen.sunlit_levels == pytest.approx([0.08, 0.75], abs=0.002)
    assert seen.edges.rows[0, 3:] == pytest.approx([-0.04, -0.375], abs=0.003)
    assert not seen.is_burnt(HIGH)


def test_a_strip_has_two_edges_and_hides_nothing() -> None:
    seen = find_shadows(flat_under([], STRIP), Tone.LINEAR)[0]
    assert seen.edges.single_count == 0
    assert lines_of(seen) == pytest.approx(np.array(STRIP)[:, :2], abs=0.2)
    assert seen.edges.rows[:, 4] == pytest.approx([-0.375, 0.375], abs=0.02)


def test_a_strip_is_distinguished_from_the_shade_that_it_runs_into() -> None:
    """The edge is found first, although the strip increases the variance it explains."""
    first, both = find_shadows(flat_under([EDGE], STRIP), Tone.LINEAR)
    assert (first.edges.single_count, len(first.edges.rows)) == (1, 1)
    assert (both.edges.single_count, len(both.edges.rows)) == (1, 3)
    assert lines_of(both) == pytest.approx(np.array([EDGE, *STRIP])[:, :2], abs=0.2)
    assert both.edges.rows[:, 4] == pytest.approx([-0.375, -0.375, 0.375], abs=0.02)


def test_where_white_is_burnt_on_either_side_ink_shows_the_shadow() -> None:
    flat = flat_under([EDGE], [], ink=0.12, plate=1.9, left=0.6)
    assert flat.levels[flat.kind == 1].min() == 1.0
    (seen,) = find_shadows(flat, Tone.LINEAR)
    assert seen.is_burnt(HIGH)
    assert lines_of(seen)[0] == pytest.approx(EDGE[:2], abs=0.6)
    assert seen.edges.rows[0, 3] == pytest.approx(-0.048, abs=0.003)


def test_a_highlight_beside_burnt_white_is_not_taken_for_shade() -> None:
    """It adds the same to ink and to white, where it is not visible."""
    flat = flat_under([EDGE], [], ink=0.5, plate=1.9, left=0.4)
    assert find_shadows(flat, Tone.LINEAR) == []


def test_edges_seen_on_ink_alone_are_rejected() -> None:
    flat = flat_under([], [])
    levels = flat.levels + 0.2 * ((flat.kind == 0) & (flat.offsets[0] > 5.0))
    assert find_shadows(PlateauPixels(flat.offsets, flat.kind, levels, HIGH), Tone.LINEAR) == []


@pytest.mark.parametrize(("ink", "plate"), [(0.0, 1.0), (0.4, 0.4), (0.8, 0.3), (0.0, 0.0)])
def test_without_noise_or_contrast_there_are_no_shadows(ink: float, plate: float) -> None:
    flat = flat_under([], [])
    levels = np.where(flat.kind, plate, ink)
    assert find_shadows(PlateauPixels(flat.offsets, flat.kind, levels, HIGH), Tone.LINEAR) == []


def test_ink_that_is_brighter_than_plate_is_in_no_shade() -> None:
    assert find_shadows(flat_under([EDGE], [], ink=0.7, plate=0.2), Tone.LINEAR) == []


def test_the_step_that_explains_most_is_found() -> None:
    """Compared with sums over every pair of borders."""
    rng = np.random.default_rng(8)
    offsets, kind = rng.uniform(-RADIUS_PX, RADIUS_PX, (2, 300)), rng.integers(0, 2, 300)
    values = rng.standard_normal(300) + 0.8 * (offsets[0] > 7.0)
    reach_px = float(np.hypot(*offsets).max())
    gain, angle, first, last, ink, plate = _best_step(offsets, values, kind, reach_px)
    most, found, number = 0.0, (0.0, 0, 0), _BORDERS - 1
    for way in math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS:
        along_px = math.cos(way) * offsets[0] + math.sin(way) * offsets[1]
        before = np.minimum((0.5 * number * (along_px / reach_px + 1.0)).astype(int), number - 1)
        for near in range(1, number):
            within = before[:, None] < np.arange(near + 1, number + 1)
            within &= (before >= near)[:, None]
            by_kind = [_explained(values[kind == k], within[kind == k]) for k in (0, 1)]
            explained = by_kind[0] + by_kind[1]
            explained[:-1] *= _STRIP_FACTOR
            if explained.max() > most:
                most = float(explained.max())
                found = way, near, near + 1 + int(explained.argmax())
    assert gain == pytest.approx(most)
    assert last == number  # a step, not a strip
    assert (angle, first, last) == pytest.approx(found)
    for k, step in enumerate((ink, plate)):
        own = values[kind == k]
        along_px = offsets[:, kind == k].T @ (math.cos(angle), math.sin(angle))
        is_beyond = along_px >= np.linspace(-reach_px, reach_px, _BORDERS)[first]
        assert step == pytest.approx(own[is_beyond].mean() - own[~is_beyond].mean())


def _explained(values: FloatArray, within: BoolArray) -> FloatArray:
    """Of squares, by steps (b,) that hold some of the values, given as columns (n, b)."""
    count = within.sum(axis=0)
    enough = np.minimum(count, len(values) - count) >= _MIN_PIXELS
    inside = values @ within / np.maximum(count, 1)
    outside = values @ ~within / np.maximum(len(values) - count, 1)
    left = np.sum((values[:, None] - np.where(within, inside, outside)) ** 2, axis=0)
    return np.where(enough, np.sum((values - values.mean()) ** 2) - left, 0.0)
