from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.bias_causes import Term
from kgcp.quality.bias_study import BiasStudy, Comparison, ReferenceSds
from kgcp.quality.checks.doubt import Cause, grave, mild
from kgcp.report.bias.numbers import BiasNumbers, bias_numbers
from kgcp.report.bias.reexposure import Reexposed
from kgcp.report.bias.verdict import FlightGrade, assess
from kgcp.report.bias.wording import meaning_of, signed_amount

Compare = Callable[..., Comparison]
Study = Callable[..., BiasStudy]
Fly = Callable[..., BiasNumbers]


@pytest.fixture
def fly(compare: Compare, study: Study) -> Fly:
    """Fly 80 frames with errors of 2 cm that are reported as such, and what is added to them."""

    def flown(
        added_m: Callable[[FloatArray], FloatArray] = np.zeros_like,
        sd_m: float = 0.02,
        found: int = 80,
        noise_m: float = 0.02,
    ) -> BiasNumbers:
        rng = np.random.default_rng(11)
        distance = np.exp(rng.uniform(np.log(10.0), np.log(100.0), 80))
        error = noise_m * rng.standard_normal(80) + added_m(distance)
        return bias_numbers(
            study(
                *(
                    compare(
                        d,
                        100.0 * e / d if i < found else None,
                        sd_m=0.001,
                        time_s=float(i),
                        sds=ReferenceSds(sd_m, 0.001, 0.0),
                    )
                    for i, (d, e) in enumerate(zip(distance, error, strict=True))
                )
            )
        )

    return flown


def texts(numbers: BiasNumbers, grade: FlightGrade | None = None) -> str:
    findings = assess(numbers).findings
    return "\n".join(finding.text for finding in findings if grade in {None, finding.grade})


def test_numbers_are_those_of_the_study(compare: Compare, study: Study) -> None:
    numbers = bias_numbers(
        study(
            compare(12.0, 0.1),
            compare(18.0, 0.3),
            compare(61.0, -0.4),
            compare(64.0, None),
            compare(65.0, 9.0, off_px=400.0),
        )
    )
    assert [row.label for row in numbers.bins] == ["10–20 m", "60–70 m"]
    assert numbers.bins[0].percent.mean == pytest.approx(0.2)
    assert numbers.halves[0].percent.rms == pytest.approx(np.sqrt(0.05))
    assert numbers.halves[1].metres.mean == pytest.approx(-0.244)
    assert [(rate.detected, rate.frames) for rate in numbers.rates] == [(2, 2), (1, 3)]
    # radii of 75, 50 and about 14 px: borders at 13 px times powers of √2
    assert [(round(rate.low), rate.frames) for rate in numbers.radius_rates] == [
        (13, 3),
        (37, 1),
        (74, 1),
    ]
    assert numbers.misplaced == ("f_65.00.jpg",)
    assert numbers.left_out == (("no_reference_pose", 1),)
    assert numbers.sd_reference_m == pytest.approx(0.02)
    assert numbers.regression is None


def test_a_flight_that_is_as_reported_is_good(fly: Fly) -> None:
    numbers = fly()
    assert assess(numbers).grade is FlightGrade.GOOD
    assert assess(numbers).sentences[0] == "Good."
    assert numbers.standardised is not None
    assert numbers.standardised.sd == pytest.approx(1.0, abs=0.25)
    assert "Not significant: scale" in texts(numbers)
    assert "No exposure quantity varies" in texts(numbers)


def test_a_flight_whose_points_are_wrong_is_not_good(fly: Fly) -> None:
    verdict = assess(fly(), agrees=False)
    assert verdict.grade is FlightGrade.LOOK
    assert "Vehicle and camera do not put the target at the same place" in verdict.sentences[1]
    slight = mild(Cause.CLOCK, "late", "wait")
    verdict = assess(fly(), doubts=[slight, slight])
    assert verdict.grade is FlightGrade.LOOK
    assert verdict.sentences[1] == "The inputs raise 2 doubts."


def test_a_grave_doubt_is_not_followed_by_other_causes(fly: Fly) -> None:
    """Times that are off by a second looked like a lever arm of another length."""
    numbers = fly(lambda d: np.full_like(d, -0.08))
    assert "check lever arm" in " ".join(assess(numbers).sentences)
    wrong_times = grave(Cause.CLOCK, "frames and trajectory differ in time", "correct the times")
    verdict = assess(numbers, doubts=[wrong_times], agrees=False)
    assert "lever arm" not in " ".join(verdict.sentences)
    assert "The inputs raise a grave doubt: correct them first." in " ".join(verdict.sentences)


def test_focal_length_and_lever_arm_are_named(fly: Fly) -> None:
    by_scale = texts(fly(lambda d: 0.004 * d), FlightGrade.LOOK)
    assert "focal length" in by_scale
    assert "lever arm" not in by_scale
    by_offset = texts(fly(lambda d: np.full_like(d, -0.08)), FlightGrade.LOOK)
    assert "lever arm" in by_offset
    assert "focal length" not in by_offset
    assert "too short" in by_offset


def test_significant_but_small_errors_keep_the_grade_good(fly: Fly) -> None:
    numbers = fly(lambda d: np.full_like(d, 0.004), sd_m=0.0001, noise_m=0.001)
    assert "lever arm" in texts(numbers, FlightGrade.GOOD)
    assert assess(numbers).grade is FlightGrade.GOOD


def test_errors_that_the_reference_can_cause_are_no_finding(fly: Fly) -> None:
    """An offset of 20 mm, far beyond the noise of 1 mm, by a reference that is known to 20 mm."""
    numbers = fly(lambda d: np.full_like(d, 0.02), sd_m=0.02, noise_m=0.001)
    assert numbers.regression is not None
    assert any(term.is_significant for term in numbers.regression.terms)
    text = texts(numbers, FlightGrade.GOOD)
    assert "Errors of the reference may explain scale" in text
    assert assess(numbers).grade is FlightGrade.GOOD


def test_a_flight_of_rubbish_is_not_usable(fly: Fly) -> None:
    numbers = fly(lambda d: 0.03 * d * np.sin(d))
    assert assess(numbers).grade is FlightGrade.UNUSABLE
    assert assess(numbers).findings[0].grade is FlightGrade.UNUSABLE


def test_standard_deviations_that_are_too_small_are_found(fly: Fly) -> None:
    too_small = texts(fly(sd_m=0.005), FlightGrade.LOOK)
    assert "times as much as their reported standard deviations" in too_small
    assert "the ring not round, the plate not flat, or the distortion" in too_small
    too_large = fly(sd_m=0.1)
    assert "may be too large" in texts(too_large)
    assert assess(too_large).grade is FlightGrade.GOOD


def test_distances_that_follow_the_grey_values_are_found(fly: Fly) -> None:
    def again(*changes: float | None) -> list[Reexposed]:
        return [Reexposed(0, 1.6, 20.0, change, 0.01, 0.3) for change in changes]

    numbers = fly()
    steady = assess(numbers, again(0.01, -0.02, None))
    assert steady.grade is FlightGrade.GOOD
    assert "change by 0.016 % (RMS of 2; not measured: 1)" in "\n".join(steady.sentences)
    assert assess(numbers, again(0.5, 0.01)).grade is FlightGrade.LOOK


def test_outliers_and_misses_are_counted(fly: Fly) -> None:
    wild = np.zeros(80)
    wild[:6] = 3.0
    numbers = fly(lambda _: wild)
    assert numbers.regression is not None
    assert np.flatnonzero(numbers.regression.outlier).tolist() == [0, 1, 2, 3, 4, 5]
    assert "6 outliers" in texts(numbers)
    assert "Detected in 50 of 80" in texts(fly(found=50), FlightGrade.LOOK)


def test_a_constant_offset_is_called_a_bias_and_noise_is_not(
    compare: Compare, study: Study
) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.1, 60)
    noise -= noise.mean()
    distances = np.linspace(10.0, 100.0, 60)
    plain = bias_numbers(study(*map(compare, distances, noise)))
    shifted = bias_numbers(study(*map(compare, distances, noise - 0.2)))
    assert not plain.biased
    assert [row.label for row in shifted.biased] == ["over all distances"]
    assert "too short" in texts(shifted)
    assert "No bias beyond noise" in texts(plain)


def test_a_mean_error_that_the_reference_can_cause_is_no_bias(
    compare: Compare, study: Study
) -> None:
    rng = np.random.default_rng(8)
    errors = rng.normal(0.12, 0.05, 40)  # known to 0.02 m: 0.1 % at 20 m, for all frames alike
    numbers = bias_numbers(study(*map(compare, np.linspace(18.0, 22.0, 40), errors)))
    assert numbers.total.sd_reference_percent == pytest.approx(0.1, rel=0.01)
    assert not numbers.biased
    assert "errors of the reference" in texts(numbers)


def test_a_bias_in_the_far_half_only_is_found(compare: Compare, study: Study) -> None:
    rng = np.random.default_rng(6)
    near = zip(np.linspace(10, 49, 40), rng.normal(0.0, 0.3, 40), strict=True)
    far = zip(np.linspace(51, 100, 12), rng.normal(0.15, 0.05, 12), strict=True)
    numbers = bias_numbers(study(*(compare(d, e) for d, e in (*near, *far))))
    assert [row.label for row in numbers.biased] == ["50 m and more"]
    assert "too long (50 m and more)" in texts(numbers)


def test_an_influence_of_exposure_is_named(compare: Compare, study: Study) -> None:
    rng = np.random.default_rng(4)
    white = rng.uniform(0.3, 1.0, 60)
    distances = rng.uniform(10.0, 100.0, 60)
    errors = 0.02 * (white - 0.6) * distances + rng.normal(0.0, 0.05, 60)
    numbers = bias_numbers(
        study(*(compare(d, e, white=w) for d, e, w in zip(distances, errors, white, strict=True)))
    )
    assert [influence.quantity.name for influence in numbers.influences] == ["white"]
    slope = numbers.influences[0].residual
    assert slope is not None
    assert slope.probability < 1e-6
    assert "depends on the exposure (level of white)" in texts(numbers, FlightGrade.LOOK)


def test_rounding_is_not_an_exposure_that_varies(compare: Compare, study: Study) -> None:
    compared = [compare(20.0 + i, 0.01 * i, white=0.8 + 2e-16 * (i % 2)) for i in range(9)]
    assert bias_numbers(study(*compared)).influences == ()


def test_reservations_against_the_numbers_are_stated(compare: Compare, study: Study) -> None:
    numbers = bias_numbers(study(compare(30.0, 0.1), attitudes_agree=False))
    assert "check omega, phi, kappa" in texts(numbers, FlightGrade.LOOK)
    assert "One frame is not enough to determine a bias." in texts(numbers)


def test_amounts_are_rounded_according_to_their_deviation() -> None:
    assert signed_amount(0.0010234, 0.000123, "%", 100.0) == "+0.102 ± 0.012 %"
    assert signed_amount(-12.34, 5.6, "mm") == "−12.3 ± 5.6 mm"
    assert signed_amount(-0.001, 56.0, "mm") == "0 ± 56 mm"
    assert signed_amount(0.5, None, "%") == "+0.5 %"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("scale", 0.001, "too large"),
        ("scale", -0.001, "too small"),
        ("offset_m", 0.03, "lower"),
        ("offset_m", -0.03, "higher"),
        ("edge_curvature_px2", 0.5, "into the dark ring"),
        ("edge_shift_px", 1.0, "+1.000 ± 0.010 px per pixel of δ"),
        ("iso", 0.1, "per doubling"),
    ],
)
def test_every_term_has_its_sentence(name: str, value: float, words: str) -> None:
    assert words in meaning_of(Term(name, value, 0.01, 1e-9))
    assert meaning_of(Term(name, value, 0.01, 0.5)).startswith("No ")


def test_measurement_and_reference_are_stated_side_by_side(fly: Fly) -> None:
    """Flown with 20 mm and 1 mm of the reference, and 1 mm of the measurement."""
    assert "Reference distances are known to 20 mm, measured ones to 1 mm" in texts(fly())


def test_each_bias_is_stated_with_the_error_the_reference_can_cause(fly: Fly) -> None:
    biased = texts(fly(lambda distance: 0.005 * distance))
    assert re.search(r"by \+0\.\d+ ± 0\.\d+ % \(the reference can cause ± 0\.\d+ %\)", biased)
    assert re.search(r"same percentage\. Errors of the reference can cause ± 0\.\d+ %\.", biased)
    fine = texts(fly())
    assert re.search(r"constant offset \S+ ± \S+ mm \(the reference can cause ± 20 mm\)", fine)
