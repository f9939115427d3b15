from __future__ import annotations

import numpy as np
import pytest

from kgcp.bias.study import Attempt, BiasStudy, Comparison, Exposure
from kgcp.report.figures import error_against_distance
from kgcp.report.numbers import bias_numbers
from kgcp.report.page import render_page, verdict
from kgcp.target.sighting import Sighting


def _comparison(
    distance_m: float, percent: float | None, white: float | None = None, off_px: float = 0.0
) -> Comparison:
    frame = f"f_{distance_m:.2f}.jpg"
    sighting = None
    if percent is not None:
        measured_m = distance_m * (1.0 + 0.01 * percent)
        at = np.array([500.0 + off_px, 500.0])
        sighting = Sighting(frame, 1, "A", 0, 0.0, at, None, measured_m, None, None)
    exposure = Exposure(None, None, None, None, white, None, None, None, None)
    attempt = Attempt(frame, "A", 0.0, sighting, exposure)
    return Comparison(attempt, distance_m, 0.02, np.array([500.0, 500.0]), 20.0)


def _study(*compared: Comparison, attitudes_agree: bool = True) -> BiasStudy:
    measured = tuple(one for one in compared if one.attempt.sighting is not None)
    return BiasStudy(measured, compared, attitudes_agree, ("lost.jpg",), ())


def test_numbers_are_those_of_the_study() -> None:
    study = _study(
        _comparison(12.0, 0.1),
        _comparison(18.0, 0.3),
        _comparison(61.0, -0.4),
        _comparison(64.0, None),
        _comparison(65.0, 9.0, off_px=400.0),
    )
    numbers = bias_numbers(study)
    assert [row.label for row in numbers.bins] == ["10–20 m", "60–70 m"]
    assert numbers.bins[0].percent.mean == pytest.approx(0.2)
    assert numbers.halves[0].percent.rms == pytest.approx(np.sqrt(0.05))
    assert numbers.halves[1].metres.mean == pytest.approx(-0.244)
    assert [(rate.detected, rate.frames) for rate in numbers.rates] == [(2, 2), (1, 3)]
    assert numbers.astray == ("f_65.00.jpg",)
    assert numbers.left_out == (("no_reference_pose", 1),)
    assert numbers.sd_reference_m == pytest.approx(0.02)


def test_a_constant_offset_is_called_a_bias_and_noise_is_not() -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.1, 60)
    noise -= noise.mean()
    distances = np.linspace(10.0, 100.0, 60)
    plain = bias_numbers(_study(*map(_comparison, distances, noise)))
    shifted = bias_numbers(_study(*map(_comparison, distances, noise - 0.2)))
    assert not plain.biased
    assert [row.label for row in shifted.biased] == ["over all distances"]
    assert any("too short" in sentence for sentence in verdict(shifted))
    assert any("No bias beyond noise" in sentence for sentence in verdict(plain))


def test_what_the_reference_may_be_off_is_no_bias() -> None:
    rng = np.random.default_rng(8)
    errors = rng.normal(0.12, 0.05, 40)  # known to 0.02 m: 0.1 % at 20 m, for all frames alike
    numbers = bias_numbers(_study(*map(_comparison, np.linspace(18.0, 22.0, 40), errors)))
    assert numbers.total.sd_reference_percent == pytest.approx(0.1, rel=0.01)
    assert not numbers.biased
    assert any("the reference's own errors" in sentence for sentence in verdict(numbers))


def test_rounding_is_not_an_exposure_that_varies() -> None:
    compared = [_comparison(20.0 + i, 0.01 * i, 0.8 + 2e-16 * (i % 2)) for i in range(9)]
    assert bias_numbers(_study(*compared)).influences == ()


def test_a_bias_of_the_far_half_alone_is_found() -> None:
    rng = np.random.default_rng(6)
    near = zip(np.linspace(10, 49, 40), rng.normal(0.0, 0.3, 40), strict=True)
    far = zip(np.linspace(51, 100, 12), rng.normal(0.15, 0.05, 12), strict=True)
    numbers = bias_numbers(_study(*(_comparison(d, e) for d, e in (*near, *far))))
    assert [row.label for row in numbers.biased] == ["50 m and more"]
    assert any("too long 50 m and more" in sentence for sentence in verdict(numbers))


def test_an_influence_of_exposure_is_named() -> None:
    rng = np.random.default_rng(4)
    white = rng.uniform(0.3, 1.0, 40)
    study = _study(
        *(
            _comparison(float(d), float(w - 0.6 + e), float(w))
            for d, w, e in zip(
                rng.uniform(10, 100, 40), white, rng.normal(0, 0.05, 40), strict=True
            )
        )
    )
    numbers = bias_numbers(study)
    assert [influence.label for influence in numbers.influences] == ["level of white"]
    assert any("follows the exposure: level of white" in line for line in verdict(numbers))


def test_one_frame_makes_a_page_too() -> None:
    numbers = bias_numbers(_study(_comparison(30.0, 0.1)))
    figure = error_against_distance(
        numbers.distance_m, numbers.residual_m, numbers.residual_percent
    )
    page = render_page("one", numbers, {"error": figure})
    assert "One frame says nothing about bias." in page
    assert page.count("<img") == 1


def test_reservations_are_spoken() -> None:
    numbers = bias_numbers(_study(_comparison(30.0, 0.1), attitudes_agree=False))
    assert any("check omega, phi, kappa" in line for line in verdict(numbers))
