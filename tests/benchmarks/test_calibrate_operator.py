"""The benchmark of discs, on few: a coarse guard of scatter, bias and stated deviations."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from benchmarks.calibrate.operator import Outcome, Setup, line, measure
from kgcp.measurement.discs.records import Operator, Polarity

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")


@cache
def outcome(case: str, used: Operator = Operator.MODEL, ratio: float = 0.8) -> Outcome:
    return measure(Setup(case, Polarity.DARK, 6.0, ratio, 2, used, 0.05))


@pytest.mark.parametrize("case", ["linear", "srgb"])
def test_discs_are_measured_at_the_bound(case: str) -> None:
    measured = outcome(case)
    assert len(measured.errors) == measured.present == 40
    assert 0.7 < measured.over_bound < 1.4
    assert abs(measured.bias_px) < 0.003
    assert abs(measured.radius_bias_px) < 0.005
    assert 0.7 < measured.z < 1.35
    assert 2.3 < measured.mahalanobis2 < 6.5
    assert case in line(measured)


def test_other_operators_are_biased_where_the_light_falls_off() -> None:
    model, gaussian = outcome("linear"), outcome("linear", Operator.GAUSSIAN)
    assert abs(gaussian.bias_px) > 0.02
    assert gaussian.over_bound > 3.0 * model.over_bound


def test_bound_is_the_formula_s() -> None:
    """σ_c = (σ_n / C) √(2 s / (√π R)) with the noise in the middle of the edge."""
    bound_px = outcome("linear", ratio=1.0).bound_px
    middle, contrast = 0.5 * (0.62 + 0.10), 0.62 - 0.10
    noise = np.sqrt(10_000.0 * middle + 64.0 + (10_000.0 / 255.0) ** 2 / 12.0) / 10_000.0
    spread = np.sqrt(0.6**2 + 1.0 / 12.0)
    formula = noise / contrast * np.sqrt(2.0 * spread / (np.sqrt(np.pi) * 6.0))
    assert bound_px == pytest.approx(formula, rel=0.12)
