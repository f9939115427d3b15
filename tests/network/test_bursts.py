"""Photographs from nearly one pose are of one place, whose model errors count once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import rotation_about
from kgcp.network.adjust import adjust_network
from kgcp.network.bursts import place_numbers
from kgcp.network.covariance import precision
from kgcp.network.records import Estimate, Precision
from tests.network.conftest import SimulatedNetwork, repeated, simulated

PLACES, TIMES = 8, 4
CENTRE_PX = np.array([811.0, 583.0])
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def with_own_lenses(made: SimulatedNetwork, rng: np.random.Generator) -> SimulatedNetwork:
    """Return noisy photographs, with lens errors for each place that the model does not contain."""
    noisy = made.observed(rng)
    observed = noisy.network.observations
    stretch = 1.0 + 2e-4 * rng.standard_normal((PLACES, 2))
    places = CENTRE_PX + (observed.places - CENTRE_PX) * stretch[observed.view % PLACES]
    observations = replace(observed, places=places)
    return replace(noisy, network=replace(noisy.network, observations=observations))


def adjusted(made: SimulatedNetwork) -> tuple[FloatArray, Precision]:
    """Return the errors (p,) of the camera, and the calibration with its deviations."""
    solution = adjust_network(made.network, made.truth)
    error = (solution.estimate.cameras - made.truth.cameras)[0]
    return error, precision(made.network, solution)


def moved(truth: Estimate, view: int, turn: FloatArray, shift_m: FloatArray) -> Estimate:
    """Return the poses with one camera rotated about its projection centre, then shifted."""
    rotations, translations = truth.rotations.copy(), truth.translations.copy()
    rotations[view] = rotation_about(turn) @ rotations[view]
    translations[view] = rotation_about(turn) @ translations[view] - shift_m
    return replace(truth, rotations=rotations, translations=translations)


def test_deviations_of_a_burst_cover_its_errors(rng: np.random.Generator) -> None:
    """Four photographs of a place share its lens errors and have independent noise."""
    once, burst = simulated(PLACES), repeated(simulated(PLACES), TIMES)
    ratios, gains = [], []
    for _ in range(16):
        seed = int(rng.integers(1 << 32))
        one, four = (
            adjusted(with_own_lenses(made, np.random.default_rng(seed))) for made in (once, burst)
        )
        ratios.append([error / np.sqrt(k.camera_cov.diagonal()) for error, k in (one, four)])
        gains.append(np.sqrt(one[1].camera_cov.diagonal() / four[1].camera_cov.diagonal()))
    by_one, by_four = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert 0.85 < by_one < 1.4
    assert 0.85 < by_four < 1.4
    assert 0.9 < np.median(gains) < 1.6


def test_a_photograph_repeated_four_times_counts_once(
    rng: np.random.Generator,
) -> None:
    once = with_own_lenses(simulated(PLACES), rng)
    _, single = adjusted(once)
    _, fourfold = adjusted(repeated(once, TIMES))
    assert single.places.tolist() == list(range(PLACES))
    assert fourfold.places.tolist() == TIMES * list(range(PLACES))
    sd, same = (np.sqrt(known.camera_cov.diagonal()[:3]) for known in (single, fourfold))
    assert same == pytest.approx(
        sd, rel=0.05
    )  # not of the distortion, whose formal deviation is larger


@pytest.mark.parametrize("axis", AXES)
def test_photographs_with_equal_centre_and_rotation_are_of_one_place(
    axis: tuple[float, float, float],
) -> None:
    made = repeated(simulated(PLACES), 2)
    still, far_m, direction = np.zeros(3), 0.33, np.array(axis)
    together, apart = 2 * list(range(PLACES)), [*range(PLACES), 0, 1, PLACES, *range(3, PLACES)]
    for turn, shift_m, expected in (
        (0.02 * direction, still, together),
        (still, 0.02 * far_m * direction, together),
        (0.04 * direction, still, apart),
        (still, 0.04 * far_m * direction, apart),
    ):
        estimate = moved(made.truth, PLACES + 2, turn, shift_m)
        assert place_numbers(made.network, estimate).tolist() == expected


def test_frames_of_a_film_are_of_many_places() -> None:
    """Each photograph is near the one before; only those near the first one are of its place."""
    made = repeated(simulated(1), 24)
    estimate = made.truth
    for view in range(24):
        estimate = moved(estimate, view, np.array([0.0, 0.008 * view, 0.0]), np.zeros(3))
    numbers = place_numbers(made.network, estimate)
    assert np.all(np.diff(numbers) >= 0)
    assert np.bincount(numbers).tolist() == 6 * [4]


def test_two_cameras_at_one_place_count_as_two_places() -> None:
    made = repeated(simulated(3), 2)
    network = replace(made.network, view_camera=np.repeat([0, 1], 3))
    assert place_numbers(network, made.truth).tolist() == list(range(6))
