"""KGCP positions of simulated flights against their truth, trajectory errors off and on."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.georef.camera_priors import camera_priors, opk_deg
from kgcp.georef.gcp import build_gcps
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.simulation.flight import CRS, frame_name, plan_flight
from kgcp.simulation.presets import SimulationSettings, preset


def _errors(settings: SimulationSettings, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return errors (n, 3) and covariances (n, 3, 3) of frames well apart in time."""
    plan = plan_flight(settings, seed)
    target_positions = TargetPositions.of(CRS, [], plan.trajectory, plan.vehicle)
    chosen = slice(0, None, 15)  # the trajectory's errors last for seconds
    times = [float(time_s) for time_s in plan.recorded_times_s[chosen]]
    positions = target_positions.positions(["A"] * len(times), times)
    truth = target_positions.local_frame.enu_from_map(plan.target_map[chosen])
    known = [place for place in positions if isinstance(place, TargetPosition)]
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


def test_the_camera_is_oriented_as_it_was_simulated() -> None:
    """The simulator turns the plate onto its vehicle on its own."""
    plan = plan_flight(preset("clean").without_survey_errors(), seed=1)
    target_positions = TargetPositions.of(CRS, [], plan.trajectory, plan.vehicle)
    chosen = [frame for frame in plan.frames if frame.present][::8]
    sightings = [
        Sighting(
            frame=frame_name(plan.settings, frame.index),
            number=frame.index + 1,
            target="A",
            instance=0,
            time_s=float(plan.recorded_times_s[frame.index]),
            centre_px=np.array([0.0, 0.0]),
            centre_cov_px2=None,
            distance_m=frame.target.distance_m,
            sd_distance_m=None,
            sd_common_distance_m=None,
            pose=frame.target,
        )
        for frame in chosen
    ]
    gcps, _ = build_gcps(sightings, target_positions, plan.settings.camera)
    priors = camera_priors(gcps, sightings, target_positions, target_positions.local_frame)
    assert len(priors) == len(chosen) > 5
    rows = [frame.index for frame in chosen]
    positions = np.array([prior.position_map for prior in priors])
    np.testing.assert_allclose(positions, plan.reference.position_map[rows], atol=2e-3)
    turns = (opk_deg(priors) - plan.reference.opk_deg[rows] + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(turns, 0.0, atol=2e-3)
