"""Polar patches of rings in uneven light: correction of the light, and other codes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.template_match import match_templates
from kgcp.measurement.search.templates import ANGLES, ANGLES_RAD, SHIFTS, templates_of
from kgcp.measurement.search.uneven_light import _smooth_levels, light_corrected_patch
from kgcp.targets.layout import Ring, Target

TURN = 17


def patch_of(ring: Ring, light: FloatArray, added: FloatArray | float = 0.0) -> FloatArray:
    """A sharp ring, turned, in light that depends on the angle."""
    templates = templates_of(ring)
    image = np.roll(templates.images[0], TURN, axis=1)
    rows = np.pad(image, ((SHIFTS, SHIFTS), (0, 0)), mode="edge")
    return np.asarray((20.0 + 150.0 * rows) * light + added)


def half_in_shade() -> FloatArray:
    return np.where(np.cos(ANGLES_RAD - 1.0) > 0.2, 0.45, 1.0)


def test_even_light_is_left_as_it_is(target: Target) -> None:
    assert (
        light_corrected_patch(patch_of(target.ring, np.ones(ANGLES)), target.ring, SHIFTS) is None
    )


def test_a_ring_half_in_shade_matches_clearly(target: Target) -> None:
    patch = patch_of(target.ring, half_in_shade())
    even = light_corrected_patch(patch, target.ring, SHIFTS)
    assert even is not None
    template_match = match_templates(patch, target.ring, 40.0)
    assert template_match.is_clear
    assert template_match.lag_deg == pytest.approx(TURN * 360.0 / ANGLES, abs=3.1)


def test_a_highlight_on_a_ring_is_corrected(target: Target) -> None:
    added = 90.0 * np.exp(-0.5 * ((ANGLES_RAD - 2.0) / 0.8) ** 2)
    assert match_templates(
        patch_of(target.ring, np.ones(ANGLES), added), target.ring, 40.0
    ).is_clear


@pytest.mark.parametrize("code_deg", [(0.0, 43.0, 78.0, 180.0, 260.0), (0.0, 43.0, 180.0)])
def test_another_code_in_shade_is_not_taken_for_the_target(
    target: Target, code_deg: tuple[float, ...]
) -> None:
    shown = replace(target.ring, code_deg=code_deg)
    assert not match_templates(patch_of(shown, half_in_shade()), target.ring, 40.0).is_clear


def test_the_light_on_small_rings_is_not_corrected(target: Target) -> None:
    patch = patch_of(target.ring, half_in_shade())
    assert match_templates(patch, target.ring, 8.5).is_clear
    assert not match_templates(patch, target.ring, 7.5).is_clear


@pytest.mark.parametrize(("rank", "half"), [(7, 10), (5, 5), (0, 3)])
def test_smooth_levels_are_smoothed_rank_filters(rank: int, half: int) -> None:
    circles = np.random.default_rng(half).integers(0, 9, (2, ANGLES)).astype(float)
    turned = [np.roll(circles, step, axis=1) for step in range(-half, half + 1)]
    ranked = np.sort(turned, axis=0)[rank]
    weights = np.exp(-0.5 * (np.arange(-8, 9) / 3.0) ** 2)
    smoothed = sum(
        weight * np.roll(ranked, step, axis=1)
        for weight, step in zip(weights, range(-8, 9), strict=True)
    )
    np.testing.assert_allclose(
        _smooth_levels(circles, rank, half), smoothed / weights.sum(), atol=1e-12
    )
