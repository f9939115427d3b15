from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.bias_causes import Regression, Term, regress
from kgcp.quality.bias_study import BiasStudy, edge_distances
from kgcp.quality.exposure_effects import QUANTITIES, DistanceResiduals, in_time
from kgcp.quality.robust_gls import ErrorModel
from kgcp.report.bias.wording import exposure_sentence, meaning_of
from kgcp.settings import Method

Fly = Callable[..., BiasStudy]

SCALE, OFFSET_M = 0.001, 0.030
SEEDS = range(5)


def by(study: BiasStudy, edges: int | None = None) -> Regression:
    """Regress the reported distances, or those by one or two edges."""
    compared = in_time(study.trusted)
    measured, radii = [], []
    for one in compared:
        found = edge_distances(one, study.method)
        assert found is not None
        assert one.attempt.sighting is not None
        reported = one.attempt.sighting.distance_m
        measured.append({None: reported, 1: found.by_outer_edge_m, 2: found.by_both_edges_m}[edges])
        radii.append(found.outer_radius_px)
    radius = np.array(radii) if edges == 1 else None
    regression = regress(DistanceResiduals.of(compared, np.array(measured), radius))
    assert regression is not None
    return regression


def term_of(found: Regression, name: str) -> Term | None:
    return next((term for term in found.terms if term.name == name), None)


def errors(found: Regression, **truth: float) -> list[float]:
    """Errors of terms over their deviations."""
    terms = [(term_of(found, name), value) for name, value in truth.items()]
    return [(term.value - value) / term.sd for term, value in terms if term is not None]


def test_injected_errors_are_recovered_within_their_deviations(fly: Fly) -> None:
    """0.1 % of focal length, 30 mm of lever arm, and all of δ with the one-edge method."""
    scaled = []
    for seed in SEEDS:
        found = by(fly(seed, Method.PAPER, SCALE, OFFSET_M))
        scaled.append(errors(found, scale=SCALE, offset_m=OFFSET_M, edge_shift_px=1.0))
        shift = term_of(found, "edge_shift_px")
        assert shift is not None
        assert shift.is_significant
        assert found.exposure_share > 0.9
    assert np.mean(np.abs(scaled) < 2.0) > 0.8
    assert np.all(np.abs(scaled) < 4.0)
    assert np.all(np.abs(np.mean(scaled, axis=0)) < 1.4)  # 3 deviations of a mean of five


def test_distances_from_both_edges_do_not_depend_on_exposure(fly: Fly) -> None:
    scaled = []
    for seed in SEEDS:
        found = by(fly(seed, Method.MODEL, SCALE, OFFSET_M))
        assert not found.is_exposure_significant
        assert found.exposure_share < 0.3
        scaled.append(errors(found, scale=SCALE, offset_m=OFFSET_M, edge_shift_px=0.0))
    assert np.mean(np.abs(scaled) < 2.0) > 0.8


def test_both_methods_give_the_same_coefficient_for_one_and_two_edges(fly: Fly) -> None:
    for edges, expected in ((1, 1.0), (2, 0.0)):
        for method in Method:
            shift = term_of(by(fly(3, method), edges), "edge_shift_px")
            assert shift is not None
            assert shift.value == pytest.approx(expected, abs=4.0 * shift.sd)


def test_a_correct_flight_has_no_significant_term(fly: Fly) -> None:
    found = [by(fly(seed)) for seed in SEEDS]
    false = [term.name for one in found for term in one.terms if term.is_significant]
    assert len(false) <= 1  # at 1 % per flight
    assert 0.7 < np.mean([one.scatter for one in found]) < 1.3


def test_a_large_error_is_significant(fly: Fly) -> None:
    found = by(fly(1, Method.MODEL, 0.005, 0.15, frames=200))
    assert {term.name for term in found.terms if term.is_significant} == {"scale", "offset_m"}


def plain(
    distance_m: FloatArray, residual_m: FloatArray, sd_m: float, **exposure: FloatArray
) -> DistanceResiduals:
    n = len(distance_m)
    noise = ErrorModel(np.full(n, sd_m**2), np.zeros(n), np.arange(float(n)))
    missing = {quantity.name: np.full(n, np.nan) for quantity in QUANTITIES}
    return DistanceResiduals(distance_m, 1000.0 / distance_m, residual_m, noise, missing | exposure)


def test_lasting_errors_do_not_displace_the_systematic_part() -> None:
    rng = np.random.default_rng(0)
    n, span_s = 24, 30.0
    moved, scatter = 0.0, 0.0
    for _ in range(20):
        distance, time_s = rng.uniform(10.0, 90.0, n), np.sort(rng.uniform(0.0, span_s, n))
        wave = np.sin(time_s / span_s * rng.uniform(1.0, 4.0) + rng.uniform(0.0, 6.0))
        sd = np.full(n, 0.02)
        errors = ErrorModel(np.full(n, 0.003**2), sd**2, time_s)
        residual = 0.03 * wave + 0.003 * rng.standard_normal(n)
        found = regress(replace(plain(distance, residual, 0.01), errors=errors))
        assert found is not None
        left = (residual - found.systematic_m) / np.sqrt(errors.total)
        moved = max(moved, abs(float(left.mean())))
        scatter = max(scatter, found.scatter)
    assert moved < 0.1
    assert scatter < 1.5


def test_blur_that_grows_with_the_exposure_time_may_be_the_cause_in_its_place() -> None:
    """Motion blurs longer exposures; here it alone displaces edges, in a narrow range of times."""
    rng = np.random.default_rng(3)
    distance = rng.uniform(20.0, 90.0, 60)
    exposure_s = 0.002 * 2.0 ** rng.uniform(0.0, 1.0, 60)
    blur = np.hypot(0.5, 260.0 * exposure_s)
    residual = 0.2 * blur * distance**2 / 1300.0 + 0.005 * rng.standard_normal(60)
    found = regress(plain(distance, residual, 0.005, exposure_time_s=exposure_s, blur_px=blur))
    assert found is not None
    (term,) = found.exposure_terms
    assert (term.name, term.alike, term.is_significant) == ("exposure_time_s", ("blur_px",), True)
    both = "exposure time [s] or edge spread σ [px], which vary alike in this flight"
    assert f"on the exposure ({both})" in exposure_sentence(found)
    assert f"Distances depend on {both}" in meaning_of(term)


def test_blur_of_curved_edges_is_separated_from_scale_and_offset() -> None:
    rng = np.random.default_rng(9)
    distance = np.exp(rng.uniform(2.3, 4.6, 300))
    residual = 0.5 * distance**3 / 1000.0**2 + 0.005 * rng.standard_normal(300)  # R: 1000 / D
    found = regress(plain(distance, residual, 0.005))
    assert found is not None
    curved = term_of(found, "edge_curvature_px2")
    assert curved is not None
    assert curved.value == pytest.approx(0.5, abs=3.0 * curved.sd)
    assert found.exposure_terms == ()


def test_of_inseparable_quantities_the_later_one_is_left_out() -> None:
    rng = np.random.default_rng(3)
    distance = np.exp(rng.uniform(2.3, 4.6, 100))
    exposure = 0.001 * np.exp(rng.uniform(-1.0, 1.0, 100))
    alike = {"exposure_time_s": exposure, "white": np.log(exposure), "iso": np.full(100, 200.0)}
    residual = 0.03 * np.log2(
        1000.0 * exposure
    ) * distance**2 / 1000.0 + 0.01 * rng.standard_normal(100)
    found = regress(plain(distance, residual, 0.01, **alike))
    assert found is not None
    assert found.tangled == ("white",)
    time = term_of(found, "exposure_time_s")
    assert time is not None
    assert time.is_significant
    assert time.value == pytest.approx(0.03, abs=3.0 * time.sd)  # px per doubling
    assert time.alike == ("white",)
    assert term_of(found, "iso") is None
    assert found.exposure_share > 0.8
    assert found.exposure_probability is not None
    assert found.exposure_probability < 1e-6


def test_too_few_residuals_give_no_regression() -> None:
    distance = np.linspace(10.0, 100.0, 5)
    assert regress(plain(distance, 0.0 * distance, 0.01)) is None
    alike = 50.0 + 0.01 * np.arange(40.0)
    assert regress(plain(alike, 0.001 * np.sin(np.arange(40.0)), 0.01)) is None


def test_few_frames_have_few_terms() -> None:
    rng = np.random.default_rng(1)
    distance = np.linspace(10.0, 100.0, 13)
    many = {quantity.name: rng.uniform(1.0, 2.0, 13) for quantity in QUANTITIES}
    many["edge_shift_px"] = rng.uniform(-1.0, 1.0, 13)
    found = regress(plain(distance, 0.01 * rng.standard_normal(13), 0.01, **many))
    assert found is not None
    assert [term.name for term in found.terms] == ["scale", "offset_m", "edge_shift_px"]


def test_frames_without_a_quantity_have_no_part_and_rare_quantities_none_at_all() -> None:
    rng = np.random.default_rng(4)
    distance = np.linspace(10.0, 100.0, 60)
    white, blur = rng.uniform(0.4, 0.9, 60), rng.uniform(0.6, 0.9, 60)
    white[:3], blur[:30] = np.nan, np.nan
    residual = 0.01 * rng.standard_normal(60)
    found = regress(plain(distance, residual, 0.01, white=white, blur_px=blur))
    assert found is not None
    assert found.used.sum() == 57
    assert term_of(found, "white") is not None
    assert term_of(found, "blur_px") is None
    assert found.systematic_m.shape == (60,)
