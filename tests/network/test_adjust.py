"""The adjustment recovers the truth, states its accuracy, and is robust against wrong discs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibrate.jaicov import compare, read_network
from kgcp.network.adjust import PLAIN, adjust_network
from kgcp.network.covariance import (
    excess_scatter,
    fitting_covariances,
    precision,
    tangled,
)
from kgcp.network.equations import (
    computed,
    inner_constraints,
    moved,
    network_rows,
    reduce_poses,
    scales_of,
    view_rows,
)
from kgcp.network.point_elimination import (
    can_eliminate_points,
    determined_by_priors,
    moved_by_points,
    reduce_points,
)
from kgcp.network.records import CalibrationPrior, Estimate, PointPrior, ScaleBar
from tests.network.conftest import SD_PX, simulated

FIELDS = os.environ.get("KGCP_FIELDS", "")  # where the open sets of photographs are
JAICOV = Path(FIELDS) / "jaicov"


def test_derivatives_equal_those_of_the_projection(rng: np.random.Generator) -> None:
    free = PointPrior(simulated().network.points.nominal, np.zeros((35, 3, 3)))
    made = simulated(3, points=free)
    network, estimate = made.network, made.start(rng)
    rows = network_rows(network, estimate, np.ones(35 * 3))
    view = view_rows(network, rows)[1]
    dense = view.dense()
    for column, step in ((0, 1e-3), (1, 1e-3), (3, 1e-6), (7, 1e-7), (11, 1e-7)):
        change = np.zeros(5 + 35 * 3)
        change[view.columns[column]] = step
        cameras = estimate.cameras + change[:5]
        points = estimate.points + change[5:].reshape(-1, 3)
        there = replace(estimate, cameras=cameras, points=points)
        difference = (computed(network, there) - computed(network, estimate))[view.rows] / step
        assert np.allclose(dense[:, column] * SD_PX, difference.ravel(), rtol=2e-3, atol=2e-2)


def test_exact_discs_give_the_exact_camera(rng: np.random.Generator) -> None:
    made = simulated()
    solution = adjust_network(made.network, made.start(rng))
    assert np.allclose(solution.estimate.cameras, made.truth.cameras, rtol=1e-7, atol=1e-7)
    assert np.allclose(solution.estimate.translations, made.truth.translations, atol=1e-9)


def test_deviations_are_those_of_the_errors(rng: np.random.Generator) -> None:
    made = simulated()
    formal, clustered, pose, factors = [], [], [], []
    for _ in range(40):
        noisy = made.observed(rng)
        solution = adjust_network(noisy.network, made.truth, PLAIN)
        known = precision(noisy.network, solution)
        error = (solution.estimate.cameras - made.truth.cameras)[0]
        formal.append(error / np.sqrt(known.inverse.diagonal()))
        clustered.append(error / np.sqrt(known.camera_cov.diagonal()))
        moved = (solution.estimate.translations - made.truth.translations)[0]
        pose.append(moved / np.sqrt(known.pose_inverses[0].diagonal()[:3]))
        factors.append(known.variance_factor)
        assert known.redundancy.sum() == pytest.approx(2 * 35 * 8 - 5 - 48, abs=1e-6)
    assert 0.8 < np.sqrt(np.mean(np.square(formal))) < 1.25
    assert 0.8 < np.sqrt(np.mean(np.square(clustered))) < 1.15
    assert 0.75 < np.sqrt(np.mean(np.square(pose))) < 1.3
    assert np.mean(factors) == pytest.approx(1.0, abs=0.05)


def test_wrong_discs_are_rejected_whole(rng: np.random.Generator) -> None:
    noisy = simulated().observed(rng)
    places = noisy.network.observations.places.copy()
    wrong = rng.choice(len(places), 15, replace=False)
    places[wrong, 0] += 3.0
    observations = replace(noisy.network.observations, places=places)
    network = replace(noisy.network, observations=observations)
    solution = adjust_network(network, noisy.start(rng))
    assert not solution.is_used[wrong].any()
    assert solution.is_used.sum() >= len(places) - 17
    assert solution.estimate.cameras[0, 0] == pytest.approx(1510.0, abs=0.5)


def test_the_shape_of_a_free_field_is_estimated(rng: np.random.Generator) -> None:
    """It is determined up to shift, rotation and scale, which are those of the nominal field."""
    bend = np.zeros((35, 3))
    bend[:, 2] = 0.0005 * rng.standard_normal(35)
    nominal = simulated().network.points.nominal
    exact = simulated(points=PointPrior(nominal, np.zeros((35, 3, 3))), displaced_m=bend)
    solution = adjust_network(exact.network, replace(exact.start(rng), points=nominal))
    assert np.abs(solution.residuals).max() < 1e-5
    change = solution.estimate.points - nominal
    basis = inner_constraints(exact.network, nominal)
    assert basis.shape == (5 + 105, 7)
    assert np.abs(basis[5:].T @ change.ravel()).max() < 1e-9
    assert solution.estimate.cameras[0, 0] == pytest.approx(1510.0, abs=1e-2)


def test_a_bar_gives_a_free_field_its_scale(rng: np.random.Generator) -> None:
    nominal = simulated().network.points.nominal
    bar = ScaleBar(0, 34, 1.02 * float(np.linalg.norm(nominal[34] - nominal[0])), 1e-6)
    prior = PointPrior(nominal, np.zeros((35, 3, 3)), (bar,))
    exact = simulated(points=prior)
    solution = adjust_network(exact.network, exact.start(rng))
    size = np.linalg.norm(solution.estimate.points[34] - solution.estimate.points[0])
    assert size == pytest.approx(bar.length, rel=1e-5)


def test_a_bar_gives_a_stiff_field_its_scale_and_the_nominal_one_does_not(
    rng: np.random.Generator,
) -> None:
    """The nominal places of the bar's ends are wrong; a nominal scale would change its length."""
    nominal = simulated().network.points.nominal
    printed = 1.02 * (nominal + 0.00005 * rng.standard_normal(nominal.shape))
    length = float(np.linalg.norm(printed[34] - printed[0]))
    bar = ScaleBar(0, 34, length, 0.00005)
    information = np.broadcast_to(np.eye(3) / 0.00005**2, (35, 3, 3))
    prior = PointPrior(nominal, information, (bar,))
    made = simulated(points=prior, displaced_m=printed - nominal).observed(rng)
    solution = adjust_network(made.network, made.start(rng))
    points = solution.estimate.points
    assert np.linalg.norm(points[34] - points[0]) == pytest.approx(length, abs=0.1 * bar.sd)
    known = precision(made.network, solution)
    assert known.variance_factor == pytest.approx(1.0, abs=0.25)
    across = np.zeros(len(known.inverse))
    along = (points[34] - points[0]) / length
    across[5:8], across[-3:] = -along, along
    assert np.sqrt(across @ known.inverse @ across) == pytest.approx(bar.sd, rel=0.01)


def test_a_stiff_field_bends_no_further_than_its_prior_allows(rng: np.random.Generator) -> None:
    bend = 0.0002 * rng.standard_normal((35, 3))
    nominal = simulated().network.points.nominal
    information = np.broadcast_to(np.eye(3) / 0.0002**2, (35, 3, 3))
    made = simulated(points=PointPrior(nominal, information), displaced_m=bend).observed(rng)
    stiff = adjust_network(made.network, made.start(rng))
    fixed = adjust_network(replace(made.network, points=PointPrior(nominal, None)), made.start(rng))
    assert np.sqrt(np.mean(stiff.residuals**2)) < 1.1 * SD_PX
    assert np.sqrt(np.mean(fixed.residuals**2)) > 10 * SD_PX
    assert precision(made.network, stiff).variance_factor == pytest.approx(1.0, abs=0.25)


def test_clustered_deviations_contain_errors_common_to_a_photograph(
    rng: np.random.Generator,
) -> None:
    """Each photograph has its own lens errors, which formal deviations do not contain."""
    made = simulated(16)
    ratios = []
    for _ in range(12):
        noisy = made.observed(rng)
        view, places = noisy.network.observations.view, noisy.network.observations.places
        stretch = 1.0 + 2e-4 * rng.standard_normal((16, 2))
        own = [811.0, 583.0] + (places - [811.0, 583.0]) * stretch[view]
        observations = replace(noisy.network.observations, places=own)
        network = replace(noisy.network, observations=observations)
        solution = adjust_network(network, made.truth)
        known = precision(network, solution)
        formal = np.sqrt(known.variance_factor * known.inverse.diagonal())
        error = (solution.estimate.cameras - made.truth.cameras)[0]
        robust = np.sqrt(known.camera_cov.diagonal())
        assert np.all(robust >= formal * (1.0 - 1e-9))
        ratios.append((error / formal, error / robust))
    by_formal, by_cluster = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert by_cluster < 1.3
    assert by_formal > 1.15 * by_cluster


@pytest.mark.parametrize(("places", "parameters"), [(3, 4), (5, 5), (12, 6)])
def test_few_places_with_independent_errors_hardly_enlarge_deviations(
    rng: np.random.Generator, places: int, parameters: int
) -> None:
    """If only negative excesses were cut off, chance would add 0.3 to 0.5 of the variances."""
    expected = np.tile(np.eye(parameters) / places, (places, 1, 1))
    pulls = rng.standard_normal((200, places, parameters)) / np.sqrt(places)
    excess = [np.trace(excess_scatter(each, expected)) / parameters for each in pulls]
    assert 0.02 < np.mean(excess) < 0.25
    large = 5.0 * pulls[0]
    whole = large.T @ large - np.eye(parameters)
    is_more = np.linalg.eigvalsh(whole) > 0.0
    found = np.linalg.eigvalsh(excess_scatter(large, expected))
    assert found[is_more] == pytest.approx(np.linalg.eigvalsh(whole)[is_more], rel=0.05)


def test_covariances_are_scaled_to_the_residuals(rng: np.random.Generator) -> None:
    """Small residuals reduce them in proportion; an excess is added equally to all discs."""
    noisy = simulated().observed(rng)
    solution = adjust_network(noisy.network, noisy.truth)
    own = noisy.network.observations.cov
    assert fitting_covariances(noisy.network, solution, 9.0 * own) == pytest.approx(own, rel=0.1)
    stated = own * rng.uniform(0.01, 0.1, len(own))[:, None, None]
    added = (fitting_covariances(noisy.network, solution, stated) - stated)[:, 0, 0]
    assert np.ptp(added) < 1e-12
    assert added[0] == pytest.approx(SD_PX**2, rel=0.15)


def test_inseparable_parameters_are_named() -> None:
    """Frontal views separate neither distance and focal length nor shift and principal point."""
    assert tangled(("a", "b", "c"), np.diag([1.0, 4.0, 9.0]), 100.0) == ()
    alike = np.array([[1.0, 0.9999, 0.0], [0.9999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert tangled(("a", "b", "c"), alike, 100.0) == ("a", "b")


@pytest.mark.skipif(
    not JAICOV.is_dir(), reason="KGCP_FIELDS does not name the published adjustment"
)
def test_a_published_adjustment_is_reproduced() -> None:
    network, start, published = read_network(JAICOV)
    disturbed = Estimate(
        start.cameras + 30.0 * published.sd, start.rotations, start.translations, start.points
    )
    solution = adjust_network(network, disturbed, PLAIN)
    result = compare(solution, precision(network, solution), published)
    assert len(network.observations.view) == 9972
    assert np.abs(result.values_in_sd).max() < 0.05
    assert np.abs(result.sd_ratio - 1.0).max() < 0.02
    assert result.correlation_difference < 0.02
    assert result.s0_mm == pytest.approx(0.000405, abs=0.000005)
    assert result.points_mm < 0.0005


@pytest.mark.parametrize("cameras", [1, 2])
def test_points_may_be_eliminated_instead_of_poses(rng: np.random.Generator, cameras: int) -> None:
    """Both eliminations give the same step and the same share of the priors."""
    bend = 0.0002 * rng.standard_normal((35, 3))
    nominal = simulated().network.points.nominal
    information = np.broadcast_to(np.diag([1.0, 2.0, 0.5]) / 0.0002**2, (35, 3, 3))
    made = simulated(points=PointPrior(nominal, information), displaced_m=bend).observed(rng)
    network, start = made.network, made.start(rng)
    prior = network.cameras
    network = replace(
        network,
        view_camera=np.arange(len(network.view_camera)) % cameras,
        cameras=CalibrationPrior(prior.values.repeat(cameras, 0), prior.sd.repeat(cameras, 0)),
    )
    start = replace(start, cameras=start.cameras.repeat(cameras, 0))
    weights = rng.uniform(0.2, 1.0, len(network.observations.view))
    equations = network_rows(network, start, weights)
    assert can_eliminate_points(network)
    by_points = moved_by_points(network, start, reduce_points(network, start, equations, 0.0))
    system = reduce_poses(network, start, equations)
    scale = 1.0 / np.sqrt(system.normal.diagonal())
    step = scale * np.linalg.solve(system.normal * np.outer(scale, scale), scale * system.right)
    by_poses = moved(network, start, system, step)
    assert np.allclose(by_points.cameras, by_poses.cameras, rtol=1e-9, atol=1e-9)
    assert np.allclose(by_points.points, by_poses.points, atol=1e-12)
    assert np.allclose(by_points.translations, by_poses.translations, atol=1e-12)
    assert np.allclose(by_points.rotations, by_poses.rotations, atol=1e-11)
    shares = determined_by_priors(network, reduce_points(network, start, equations))
    inverse = np.linalg.inv(system.normal)
    first = 5 * cameras
    blocks = inverse[first:, first:].reshape(35, 3, 35, 3)[np.arange(35), :, np.arange(35), :]
    assert shares == pytest.approx(float(np.sum(blocks * information)), rel=1e-6)


def test_variances_that_rounding_makes_negative_count_as_undetermined() -> None:
    """Frontal views of 80 discs leave −0.005 of the focal length's element, 1e-10 of it."""
    assert scales_of(np.diag([4.0, 0.25])).tolist() == [0.5, 2.0]
    with pytest.raises(np.linalg.LinAlgError):
        scales_of(np.diag([-0.005, 700.0]))
