"""A sheet that bends from photograph to photograph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.network import covariance
from kgcp.network.adjust import adjust_network
from kgcp.network.covariance import bend_cofactors, fitting_covariances, precision
from kgcp.network.equations import computed, moved, network_rows, reduce_poses, view_rows
from kgcp.network.point_elimination import moved_by_points, reduce_points
from kgcp.network.records import BendPrior, Estimate, PointPrior
from kgcp.network.sheet_bends import bend_displacements, bend_shapes, first_bends, next_bends
from tests.network.conftest import SD_PX, SimulatedNetwork, simulated

BEND_M = 0.0001
_STIFF = np.diag([1e-5, 1e-5, 1e-4]) ** 2


def bent(rng: np.random.Generator, bend_m: float = BEND_M, views: int = 10) -> SimulatedNetwork:
    """Photographs with noise of a stiff board that is bent otherwise in each of them."""
    nominal = simulated().network.points.nominal
    information = np.broadcast_to(np.linalg.inv(_STIFF), (35, 3, 3))
    made = simulated(views, points=PointPrior(nominal, information))
    shapes = bend_shapes(nominal)
    bends = bend_m * rng.standard_normal((views, shapes.shape[1]))
    network = replace(made.network, bends=BendPrior(shapes, max(bend_m, 1e-9)))
    return SimulatedNetwork(network, replace(made.truth, bends=bends)).observed(rng)


def start(made: SimulatedNetwork, rng: np.random.Generator) -> Estimate:
    bends = np.zeros_like(made.truth.bends)
    return replace(made.start(rng), bends=bends)


def heights(shapes: FloatArray) -> FloatArray:
    return np.asarray(shapes.T @ shapes) / len(shapes)


def test_bending_shapes_are_of_second_order_and_independent_of_the_pose() -> None:
    points = simulated().network.points.nominal
    shapes = bend_shapes(points)
    plane = np.column_stack((np.ones(35), points[:, :2]))
    assert np.allclose(heights(shapes), np.eye(3), atol=1e-12)
    assert np.allclose(plane.T @ shapes, 0.0, atol=1e-12)


def test_derivatives_by_bends_equal_those_of_the_projection(rng: np.random.Generator) -> None:
    made = bent(rng)
    network, truth = made.network, made.truth
    view = view_rows(network, network_rows(network, truth, np.ones(350)))[3]
    for bend in range(3):
        there = truth.bends.copy()
        there[3, bend] += 1e-7
        moved_px = computed(network, replace(truth, bends=there)) - computed(network, truth)
        slope = (moved_px[view.rows] / 1e-7 / SD_PX).ravel()
        assert np.allclose(view.by_pose[:, 6 + bend], slope, rtol=1e-4, atol=1.0)


def test_points_may_be_eliminated_instead_of_poses_and_bends(rng: np.random.Generator) -> None:
    made = bent(rng)
    network, first = made.network, start(made, rng)
    equations = network_rows(network, first, np.ones(350))
    by_points = moved_by_points(network, first, reduce_points(network, first, equations))
    system = reduce_poses(network, first, equations)
    scale = 1.0 / np.sqrt(system.normal.diagonal())
    step = scale * np.linalg.solve(system.normal * np.outer(scale, scale), scale * system.right)
    by_poses = moved(network, first, system, step)
    assert np.allclose(by_points.bends, by_poses.bends, atol=1e-12)
    assert np.allclose(by_points.translations, by_poses.translations, atol=1e-12)
    assert np.allclose(by_points.cameras, by_poses.cameras, rtol=1e-9, atol=1e-9)


def test_cofactors_of_bends_are_the_same_by_both_eliminations(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bars connect the points of a field, which then cannot be eliminated."""
    made = bent(rng)
    solution = adjust_network(made.network, start(made, rng))
    by_points = bend_cofactors(made.network, solution)
    factor = precision(made.network, solution).variance_factor
    monkeypatch.setattr(covariance, "can_eliminate_points", lambda _: False)
    assert np.allclose(bend_cofactors(made.network, solution), by_points, rtol=1e-9)
    assert precision(made.network, solution).variance_factor == pytest.approx(factor, rel=1e-9)


def test_bends_and_camera_are_as_accurate_as_stated(
    rng: np.random.Generator,
) -> None:
    """If the sheet is assumed to be rigid, errors of the camera are ten times as large."""
    errors, rigid_errors, found = [], [], []
    for _ in range(6):
        made = bent(rng)
        rigid = replace(made.network, bends=None)
        alone = adjust_network(rigid, replace(start(made, rng), bends=np.zeros((0, 0))))
        cov = fitting_covariances(rigid, alone, rigid.observations.cov)
        fitting = replace(rigid, observations=replace(rigid.observations, cov=cov))
        bends = first_bends(fitting, alone, bend_shapes(rigid.points.nominal))
        assert bends is not None
        network, first = made.network, start(made, rng)
        for _ in range(4):
            network = replace(network, bends=bends)
            solution = adjust_network(network, first)
            bends = next_bends(network, solution, bends)
        found.append(bends.sd)
        known = precision(network, solution)
        assert known.pose_inverses.shape == (10, 6, 6)
        off = solution.estimate.cameras[0] - made.truth.cameras[0]
        errors.append(off / np.sqrt(known.camera_cov.diagonal()))
        rigid_errors.append((alone.estimate.cameras[0] - made.truth.cameras[0]) / off)
        gaps = solution.estimate.bends - made.truth.bends
        gaps -= gaps.mean(axis=0)  # the common part belongs to the field's own shape
        sd = np.sqrt(known.variance_factor * bend_cofactors(network, solution))
        assert np.sqrt(np.mean(gaps**2)) < 0.3 * BEND_M
        assert np.sqrt(np.mean((gaps / sd) ** 2)) < 1.4
    assert np.mean(found) == pytest.approx(BEND_M, rel=0.25)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5
    assert np.median(np.abs(rigid_errors)) > 3.0


def test_a_rigid_board_has_no_bends(rng: np.random.Generator) -> None:
    for _ in range(5):
        made = bent(rng, bend_m=0.0)
        rigid = replace(made.network, bends=None)
        solution = adjust_network(rigid, replace(start(made, rng), bends=np.zeros((0, 0))))
        cov = fitting_covariances(rigid, solution, rigid.observations.cov)
        fitting = replace(rigid, observations=replace(rigid.observations, cov=cov))
        assert first_bends(fitting, solution, bend_shapes(rigid.points.nominal)) is None


def test_displacements_are_those_of_the_heights(rng: np.random.Generator) -> None:
    made = bent(rng)
    displaced = bend_displacements(made.network, made.truth)
    assert np.abs(displaced).max() > 5.0 * SD_PX
    flat = replace(made.truth, bends=np.zeros_like(made.truth.bends))
    assert not bend_displacements(made.network, flat).any()
