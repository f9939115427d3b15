from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.partial_match import (
    best_partial_template,
    may_show_code,
    visible_angles,
)
from kgcp.measurement.search.templates import (
    ANGLES,
    ANGLES_RAD,
    SHIFTS,
    best_template,
    templates_of,
)
from kgcp.targets.layout import Target

_HIGHEST = 12  # frequency of the light in these tests


def some_light(rows: int, seed: int) -> FloatArray:
    """Make smooth random grey values (rows, angles)."""
    rng = np.random.default_rng(seed)
    spectrum = rng.normal(size=(rows, _HIGHEST)) + 1j * rng.normal(size=(rows, _HIGHEST))
    return np.asarray(100.0 + 40.0 * np.fft.irfft(spectrum, ANGLES, axis=1))


def correlation(
    image: FloatArray, seen: FloatArray, weights: FloatArray, visible: np.ndarray
) -> float:
    """Return the weighted normalised cross-correlation of what is visible, by its definition."""
    share = np.repeat(weights, visible.sum())
    one, other = image[:, visible].ravel(), seen[:, visible].ravel()
    one, other = (values - np.average(values, weights=share) for values in (one, other))
    return float(share @ (one * other) / np.sqrt((share @ one**2) * (share @ other**2)))


@pytest.mark.parametrize("seed", range(3))
def test_the_best_template_is_the_best_of_all_turns_and_shifts(target: Target, seed: int) -> None:
    templates = templates_of(target.ring)
    rng = np.random.default_rng(seed)
    index, shift, lag = (int(rng.integers(n)) for n in (len(templates.images), 9, ANGLES))
    rows = templates.images.shape[1]
    patch = 2.0 * some_light(rows + 2 * SHIFTS, seed)
    patch[shift : shift + rows] += 50.0 * np.roll(templates.images[index], lag, axis=1)
    score, *place = best_template(patch, templates)
    everywhere = np.ones(ANGLES, dtype=bool)
    scores = [
        correlation(
            np.roll(image, turn, axis=1), patch[s : s + rows], templates.weights, everywhere
        )
        for image in templates.images
        for s in range(2 * SHIFTS + 1)
        for turn in range(ANGLES)
    ]
    assert score == pytest.approx(max(scores), abs=5e-3)  # higher frequencies are left out
    found = np.ravel_multi_index(place, (len(templates.images), 2 * SHIFTS + 1, ANGLES))
    assert scores[int(found)] > max(scores) - 5e-3


def test_a_ring_of_any_exposure_fits_its_template_perfectly(target: Target) -> None:
    templates = templates_of(target.ring)
    patch = np.full((len(templates.weights) + 2 * SHIFTS, ANGLES), 40.0)
    patch[3:-5] = 7.0 + 0.8 * np.roll(templates.images[9], 31, axis=1)
    score, *place = best_template(patch, templates)
    assert score == pytest.approx(1.0, abs=1e-3)
    assert place == [9, 3, 31]


@pytest.mark.parametrize("first", [20, 60, 100])
def test_what_is_seen_of_a_ring_fits_as_well(target: Target, first: int) -> None:
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
    match = best_partial_template(patch, visible, ring)
    assert match is not None
    assert match[0] == pytest.approx(1.0, abs=0.01)
    assert match[1:] == (3, SHIFTS, 17)
    expected = correlation(turned, patch[SHIFTS:-SHIFTS], templates.weights, visible)
    assert expected == pytest.approx(1.0)


@pytest.mark.parametrize("turn", [0, 11, 50, 87])
def test_along_the_code_circle_a_code_is_told_from_stripes(target: Target, turn: int) -> None:
    ring, rows = target.ring, len(templates_of(target.ring).weights)
    patch, visible = np.zeros((rows + 2 * SHIFTS, ANGLES)), np.arange(ANGLES) < 85
    patch[2 : 2 + rows] = np.roll(templates_of(ring).images[5], turn, axis=1)
    assert may_show_code(patch, visible, ring, 2)
    patch[:] = 90.0 + 40.0 * np.cos(5.0 * (ANGLES_RAD - turn))
    assert not may_show_code(patch, visible, ring, 2)


@pytest.mark.parametrize("hidden", [0, 6, 60])
def test_nothing_hidden_little_and_too_much_are_no_part(target: Target, hidden: int) -> None:
    seen = 20.0 + 150.0 * templates_of(target.ring).images[3]
    seen[:, :hidden] = 60.0
    assert visible_angles(seen, target.ring) is None
