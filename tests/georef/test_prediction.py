"""Predicted places of targets: errors agree with the stated deviations."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.georef.prediction import (
    Track,
    interpolate,
    predict_between,
    predict_by_reference,
    predict_position,
)

FRAMES = 200


def wander(rng: np.random.Generator, time_s: FloatArray, acceleration: float) -> FloatArray:
    """Centres and logarithms of radii that move under random accelerations, a new one each 2 s."""
    fine = np.arange(0.0, time_s[-1] + 0.02, 0.01)
    steps = rng.normal(0.0, 1.0, (len(fine) // 200 + 2, 3)) * (acceleration, acceleration, 0.02)
    velocity = 0.01 * np.cumsum(np.repeat(steps, 200, axis=0)[: len(fine)], axis=0)
    place = 0.01 * np.cumsum(velocity - velocity.mean(axis=0), axis=0) + (800.0, 600.0, 3.0)
    return np.column_stack([np.interp(time_s, fine, column) for column in place.T])


def without(state: FloatArray, missing: IndexArray) -> FloatArray:
    kept = state.copy()
    kept[missing] = np.nan
    return kept


def test_errors_between_neighbours_are_those_stated() -> None:
    rng = np.random.default_rng(5)
    z = []
    for _ in range(20):
        time_s = np.cumsum(rng.uniform(0.5, 1.5, FRAMES))
        state = wander(rng, time_s, 8.0)
        missing = np.arange(3, FRAMES - 3, 5)
        predictions = predict_between(Track(time_s, without(state, missing)))
        for row in missing:
            prediction = predictions[row]
            assert prediction is not None
            z.append(
                [
                    *((prediction.centre_px - state[row, :2]) / prediction.sd_px),
                    np.log(prediction.radius_px),
                ]
            )
            z[-1][2] = (z[-1][2] - state[row, 2]) / prediction.sd_log_radius
    scatter = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((scatter[:2] > 0.4) & (scatter[:2] < 1.2)), scatter
    assert scatter[2] < 1.2
    assert np.mean(np.abs(np.array(z)) > 4.0) < 0.002


def test_a_uniform_motion_is_predicted_with_the_smallest_deviations() -> None:
    time_s = np.arange(10.0)
    state = np.column_stack((100.0 + 30.0 * time_s, 50.0 + 7.0 * time_s, np.full(10, 3.0)))
    (one,) = [e for e in predict_between(Track(time_s, without(state, np.array([4])))) if e]
    np.testing.assert_allclose(one.centre_px, state[4, :2])
    assert one.radius_px == pytest.approx(np.exp(3.0))
    assert (one.sd_px, one.sd_log_radius) == pytest.approx((0.5, 0.02))


def test_only_gaps_not_much_longer_than_the_known_intervals_are_bridged() -> None:
    time_s = np.arange(30.0)
    state = np.column_stack((30.0 * time_s, 7.0 * time_s, np.full(30, 3.0)))
    track = Track(time_s, without(state, np.array([4, 5, 6, *range(12, 20)])))
    rows = [row for row, one in enumerate(interpolate(track, 4.0)) if one is not None]
    assert rows == [4, 5, 6]
    assert sum(one is not None for one in predict_between(track)) == 11


def test_predictions_of_an_erratic_motion_are_uncertain() -> None:
    rng = np.random.default_rng(2)
    time_s = np.arange(40.0)
    state = np.column_stack((rng.uniform(0, 1600, 40), rng.uniform(0, 1200, 40), np.full(40, 2.5)))
    predictions = predict_between(Track(time_s, without(state, np.arange(2, 38, 4))))
    assert not any(each.is_sure for each in predictions if each is not None)


def test_there_is_no_extrapolation_and_no_prediction_from_few_frames() -> None:
    time_s = np.arange(8.0)
    state = np.column_stack((30.0 * time_s, time_s, np.full(8, 3.0)))
    ends = predict_between(Track(time_s, without(state, np.array([0, 7]))))
    assert ends == [None] * 8
    few = predict_between(Track(time_s, without(state, np.array([1, 3, 4, 6]))))
    assert few == [None] * 8
    timeless = np.where(np.arange(8) == 4, np.nan, time_s)
    assert predict_between(Track(timeless, without(state, np.array([4])))) == [None] * 8


def test_the_deviations_of_a_reference_are_its_errors_in_other_frames() -> None:
    rng = np.random.default_rng(8)
    truth = np.column_stack((rng.uniform(0, 1600, 90), rng.uniform(0, 1200, 90), np.full(90, 3.0)))
    predicted = truth + rng.normal(0.0, 1.0, truth.shape) * (3.0, 3.0, 0.04)
    seen = without(truth, np.arange(0, 90, 3))
    seen[4, :2] += 400.0  # a wrong one does no harm
    predictions = predict_by_reference(Track(np.full(90, np.nan), seen), predicted)
    prediction = predictions[3]
    assert prediction is not None
    assert prediction.sd_px == pytest.approx(3.0, rel=0.25)
    assert prediction.sd_log_radius == pytest.approx(0.04, rel=0.3)
    np.testing.assert_array_equal(prediction.centre_px, predicted[3, :2])


@pytest.mark.parametrize(("found", "shift_px"), [(3, 0.0), (40, 60.0)])
def test_an_untested_or_wrong_reference_predicts_nothing(found: int, shift_px: float) -> None:
    truth = np.column_stack((np.arange(50.0), np.arange(50.0), np.full(50, 3.0)))
    seen = without(truth, np.arange(found, 50))
    predictions = predict_by_reference(
        Track(np.arange(50.0), seen), truth + np.array([shift_px, 0.0, 0.0])
    )
    assert predictions == [None] * 50


def test_a_bias_of_the_reference_counts_as_its_deviation() -> None:
    truth = np.column_stack((np.arange(50.0), np.arange(50.0), np.full(50, 3.0)))
    seen = without(truth, np.arange(40, 50))
    prediction = predict_by_reference(
        Track(np.arange(50.0), seen), truth + np.array([12.0, 0.0, 0.0])
    )[45]
    assert prediction is not None
    assert prediction.sd_px == pytest.approx(12.0 / 1.177, rel=0.01)


def test_the_more_certain_prediction_is_used_and_found_frames_get_none() -> None:
    time_s = np.arange(12.0)
    truth = np.column_stack((100.0 + 30.0 * time_s, 9.0 * time_s, np.full(12, 3.0)))
    track = Track(time_s, without(truth, np.array([5, 11])))
    reference = truth + np.array([2.0, 0.0, 0.0])
    predictions = predict_position(track, reference)
    assert [each is not None for each in predictions] == [row in {5, 11} for row in range(12)]
    by = [each.source for each in predictions if each is not None]
    assert by == ["its neighbours", "the reference"]
