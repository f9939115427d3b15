from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.correlation import build_bank, correlate
from kgcp.measurement.search.template_match import (
    best_placement,
    match_templates,
    may_show_code,
    visible_angles,
)
from kgcp.measurement.search.templates import ANGLES, ANGLES_RAD, SHIFTS, templates_of
from kgcp.targets.layout import Target

_HIGHEST = 12  # frequency of the light in these tests


def some_light(rows: int, seed: int) -> FloatArray:
    """Make smooth random grey values (rows, angles)."""
    rng = np.random.default_rng(seed)
    spectrum = rng.normal(size=(rows, _HIGHEST)) + 1j * rng.normal(size=(rows, _HIGHEST))
    return np.asarray(100.0 + 40.0 * np.fft.irfft(spectrum, ANGLES, axis=1))


def defined_score(
    image: FloatArray, patch: FloatArray, weights: FloatArray, visible: np.ndarray
) -> float:
    """The weighted normalised cross-correlation of what is visible, by its definition."""
    share = np.repeat(weights, visible.sum())
    pair = [image[:, visible].ravel(), patch[:, visible].ravel()]
    image, patch = (values - np.average(values, weights=share) for values in pair)
    return float(share @ (image * patch) / np.sqrt((share @ image**2) * (share @ patch**2)))


def defined_scores(image: FloatArray, patch: FloatArray, weights: FloatArray) -> list[float]:
    """`defined_score` of an image turned by every angle, all of which is visible."""
    share = np.repeat(weights, ANGLES)
    lags = (np.arange(ANGLES) - np.arange(ANGLES)[:, None]) % ANGLES  # as by np.roll
    turned = np.moveaxis(image[:, lags], 1, 0).reshape(ANGLES, -1)
    turned = turned - np.average(turned[0], weights=share)
    own = patch.ravel() - np.average(patch.ravel(), weights=share)
    squares = (share @ turned[0] ** 2) * (share @ own**2)
    scores: list[float] = (turned @ (share * own) / np.sqrt(squares)).tolist()
    return scores


def test_scores_of_all_turns_equal_the_definition(target: Target) -> None:
    templates = templates_of(target.ring)
    image, patch = templates.images[3], some_light(templates.images.shape[1], 2)
    everywhere = np.ones(ANGLES, dtype=bool)
    scores = defined_scores(image, patch, templates.weights)
    for turn in (0, 1, 31):
        turned = np.roll(image, turn, axis=1)
        expected = defined_score(turned, patch, templates.weights, everywhere)
        assert scores[turn] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("hidden", [0, 1, 37, 55])
@pytest.mark.parametrize("shape", [(3, 4, 48, 6), (1, 1, 60, 1), (2, 5, 30, 3)])
def test_scores_equal_the_definition(shape: tuple[int, ...], hidden: int) -> None:
    count, rows, angles, shifts = shape
    rng = np.random.default_rng(hidden + angles)
    spectrum = rng.normal(size=(count, rows, 12)) + 1j * rng.normal(size=(count, rows, 12))
    images = np.fft.irfft(spectrum, angles, axis=2)
    row_weights = rng.uniform(0.5, 2.0, rows)
    bank = build_bank(images, row_weights, 12)
    patch = rng.uniform(0.0, 255.0, (rows + shifts - 1, angles))
    visible = np.roll(np.arange(angles) >= hidden * angles // 100, 7)
    scores = correlate(patch, bank, visible if hidden else None)
    assert scores.shape == (count, shifts, angles)
    expected = np.empty_like(scores)
    for t, s, lag in np.ndindex(scores.shape):
        turned = np.roll(images[t], lag, axis=1)
        expected[t, s, lag] = defined_score(turned, patch[s : s + rows], row_weights, visible)
    np.testing.assert_allclose(scores, expected, rtol=0.0, atol=2e-6)


def test_unmasked_scores_equal_those_with_everything_visible(target: Target) -> None:
    templates = templates_of(target.ring)
    patch = some_light(len(templates.weights) + 2 * SHIFTS, 5)
    masked = correlate(patch, templates, np.ones(ANGLES, dtype=bool))
    np.testing.assert_allclose(correlate(patch, templates), masked, rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("seed", range(3))
def test_best_placement_is_the_maximum_over_lags_and_shifts(target: Target, seed: int) -> None:
    templates = templates_of(target.ring)
    rng = np.random.default_rng(seed)
    index, shift, lag = (int(rng.integers(n)) for n in (len(templates.images), 9, ANGLES))
    rows = templates.images.shape[1]
    patch = 2.0 * some_light(rows + 2 * SHIFTS, seed)
    patch[shift : shift + rows] += 50.0 * np.roll(templates.images[index], lag, axis=1)
    score, *place = best_placement(correlate(patch, templates))
    scores = [
        by_turn
        for image in templates.images
        for s in range(2 * SHIFTS + 1)
        for by_turn in defined_scores(image, patch[s : s + rows], templates.weights)
    ]
    assert score == pytest.approx(max(scores), abs=5e-3)  # higher frequencies are left out
    index = int(np.ravel_multi_index(place, (len(templates.images), 2 * SHIFTS + 1, ANGLES)))
    assert scores[index] > max(scores) - 5e-3


def test_a_ring_of_any_exposure_fits_its_template_perfectly(target: Target) -> None:
    templates = templates_of(target.ring)
    patch = np.full((len(templates.weights) + 2 * SHIFTS, ANGLES), 40.0)
    patch[3:-5] = 7.0 + 0.8 * np.roll(templates.images[9], 31, axis=1)
    score, *place = best_placement(correlate(patch, templates))
    assert score == pytest.approx(1.0, abs=1e-3)
    assert place == [9, 3, 31]


@pytest.mark.parametrize("first", [20, 60, 100])
def test_the_visible_part_of_a_ring_fits_as_well_as_all_of_it(target: Target, first: int) -> None:
    ring, templates = target.ring, templates_of(target.ring)
    turned = np.roll(templates.images[3], 17, axis=1)
    patch = np.full((len(templates.weights) + 2 * SHIFTS, ANGLES), 0.0)
    patch[SHIFTS:-SHIFTS] = 20.0 + 150.0 * turned
    hidden = np.arange(first, first + 26) % ANGLES
    patch[:, hidden] = 60.0
    visible = visible_angles(patch[SHIFTS:-SHIFTS], ring)
    assert visible is not None
    assert not visible[hidden].any()
    assert visible.sum() >= ANGLES - 26 - 8
    score, *place = best_placement(correlate(patch, templates, visible))
    assert score == pytest.approx(1.0, abs=0.01)
    assert place == [3, SHIFTS, 17]
    template_match = match_templates(patch, ring, 40.0)
    assert template_match.visible is not None
    assert template_match.lag_deg == pytest.approx(17 * 360.0 / ANGLES)
    assert (template_match.black, template_match.white) == pytest.approx((20.0, 170.0), abs=1.0)


@pytest.mark.parametrize("turn", [0, 11, 50, 87])
def test_stripes_do_not_match_the_code_along_the_code_circle(target: Target, turn: int) -> None:
    ring, rows = target.ring, len(templates_of(target.ring).weights)
    patch, visible = np.zeros((rows + 2 * SHIFTS, ANGLES)), np.arange(ANGLES) < 85
    patch[2 : 2 + rows] = np.roll(templates_of(ring).images[5], turn, axis=1)
    assert may_show_code(patch, visible, ring, 2)
    patch[:] = 90.0 + 40.0 * np.cos(5.0 * (ANGLES_RAD - turn))
    assert not may_show_code(patch, visible, ring, 2)


@pytest.mark.parametrize("hidden", [0, 6, 60])
def test_visible_angles_need_a_hidden_part_of_moderate_size(target: Target, hidden: int) -> None:
    seen = 20.0 + 150.0 * templates_of(target.ring).images[3]
    seen[:, :hidden] = 60.0
    assert visible_angles(seen, target.ring) is None
