"""KGCP positions of simulated flights against their truth, trajectory errors off and on."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.carrier import Place, Whereabouts
from kgcp.geometry.arrays import FloatArray
from kgcp.synthetic.flight import CRS, plan_flight
from kgcp.synthetic.presets import SimulationSettings, preset


def _errors(settings: SimulationSettings, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return errors (n, 3) and covariances (n, 3, 3) of frames well apart in time."""
    plan = plan_flight(settings, seed)
    whereabouts = Whereabouts.of(CRS, [], plan.trajectory, plan.vehicle)
    chosen = slice(0, None, 15)  # the trajectory's errors last for seconds
    times = [float(time_s) for time_s in plan.recorded_times_s[chosen]]
    places = whereabouts.places(["A"] * len(times), times)
    truth = whereabouts.frame.enu_from_map(plan.target_map[chosen])
    known = [place for place in places if isinstance(place, Place)]
    assert len(known) == len(times)
    position = np.array([place.position_m for place in known])
    return position - truth, np.array([place.cov_m2 for place in known])


def test_without_survey_errors_positions_are_true_to_a_tenth_of_a_millimetre() -> None:
    errors, _ = _errors(preset("clean").without_survey_errors(), seed=1)
    assert np.abs(errors).max() < 1e-4


def test_with_survey_errors_deviations_are_honest() -> None:
    standardised, distances = [], []
    for seed in range(1, 16):
        errors, covs = _errors(preset("clean"), seed)
        standardised.append(errors / np.sqrt(np.einsum("nii->ni", covs)))
        distances.append(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covs), errors))
    scatter = np.concatenate(standardised).std(axis=0)
    assert ((scatter > 0.75) & (scatter < 1.3)).all(), scatter
    assert np.concatenate(distances).mean() == pytest.approx(3.0, rel=0.3)
