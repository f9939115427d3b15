"""The chance of a false alarm against random light on rings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kgcp.errors import Reason, Rejection
from kgcp.geometry.pose import Pose
from kgcp.measurement.records import Appearance, Measurement
from kgcp.measurement.search.code_signal import match_code
from kgcp.measurement.search.false_alarm import (
    CHANCE_RINGS_PER_FRAME,
    check_false_alarm,
    false_code_probability,
)
from kgcp.simulation.flight import TARGET_PLATE
from kgcp.targets.layout import Ring

TARGET = TARGET_PLATE.target
MAIN, REPLICA = TARGET.rings
FRAMES = 12_000
OBSERVATION = Measurement(
    target="A",
    ring="A",
    instance=0,
    score=0.95,
    pose=Pose(Rotation.identity().as_matrix(), np.array([0.0, 0.0, 90.0])),
    centre_px=np.array([100.0, 100.0]),
    heading_deg=0.0,
    appearance=Appearance(12.0, 0.1, 0.8, 0.0, 0.0, blur_px=0.8),
    alternative=None,
    uncertainty=None,
)


@pytest.mark.parametrize("ring", [MAIN, REPLICA], ids=lambda ring: ring.name)
@pytest.mark.parametrize("blur_rad", [0.06, 0.12, 0.2, 0.3])
def test_random_rings_pass_no_more_often_than_stated_and_not_much_less(
    ring: Ring, blur_rad: float
) -> None:
    rng = np.random.default_rng(11)
    damping = np.exp(-0.5 * (np.arange(181) * blur_rad) ** 2)
    light = np.fft.irfft(np.fft.rfft(rng.normal(size=(FRAMES, 360))) * damping, 360)
    scores = match_code(light, ring)[0]
    for share in (1e-1, 1e-2, 1e-3):
        stated = false_code_probability(float(np.quantile(scores, 1.0 - share)), ring, blur_rad)
        assert 0.8 * share < stated < 15.0 * share


@given(st.floats(0.0, 0.99), st.floats(0.03, 0.4))
def test_a_higher_score_is_less_likely_and_blur_makes_it_more_so(
    score: float, blur_rad: float
) -> None:
    chance = false_code_probability(score, MAIN, blur_rad)
    assert 0.0 <= false_code_probability(score + 0.01, MAIN, blur_rad) <= chance <= 1.0
    if score > 0.7:
        assert chance <= false_code_probability(score, MAIN, 1.2 * blur_rad)


def test_the_limit_is_on_the_probability_per_frame() -> None:
    chance = CHANCE_RINGS_PER_FRAME * false_code_probability(
        0.95, MAIN, 0.8 / (12.0 * 0.642857143 / 0.9)
    )
    check_false_alarm(OBSERVATION, TARGET, MAIN, 1.01 * chance)
    with pytest.raises(Rejection, match=r"score 0\.95 occurs by chance") as caught:
        check_false_alarm(OBSERVATION, TARGET, MAIN, 0.99 * chance)
    assert caught.value.reason is Reason.CODE_MISMATCH


def test_without_a_blur_no_code_is_rejected() -> None:
    appearance = replace(OBSERVATION.appearance, blur_px=None)
    check_false_alarm(replace(OBSERVATION, score=0.1, appearance=appearance), TARGET, MAIN, 1e-12)
