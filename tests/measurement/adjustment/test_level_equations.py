"""Elimination of the levels at knots, against dense equations of all unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.level_equations import AtKnots, LevelEquations, eliminate_levels
from kgcp.measurement.image_model.noise import Misfit

PIXELS, KNOTS, REACH, OTHERS = 400, 12, 4, 7
FIRST_UNUSED = 10  # knots from there on are beyond all pixels


@dataclass(frozen=True)
class Problem:
    """Equations with the levels eliminated, and the same equations of a dense adjustment."""

    equations: LevelEquations
    misfit: Misfit
    dense: FloatArray  # Jacobian (n, p + 2 k)
    prior: FloatArray  # precision (p + 2 k,)
    values: FloatArray  # (2, k)

    @property
    def normal(self) -> FloatArray:
        weighted = self.dense * self.misfit.weight[:, None]
        return np.asarray(self.dense.T @ weighted + np.diag(self.prior))

    @property
    def gradient(self) -> FloatArray:
        state = np.append(np.zeros(OTHERS), self.values)
        return np.asarray(self.dense.T @ self.misfit.score - self.prior * state)


@pytest.fixture(scope="module")
def problem() -> Problem:
    rng = np.random.default_rng(5)
    # the first and the last knot determine the others, which may lie anywhere between them
    between = [(first + 1, last - 1) for first in range(4) for last in range(first + 3, 10)]
    cells = np.array([(a - 1, *sorted((a, b)), b + 1) for a, b in between])
    knots = cells[rng.integers(len(cells), size=PIXELS)]
    weights = rng.dirichlet(np.ones(REACH), PIXELS)
    scaled, by_level = rng.normal(size=(OTHERS, PIXELS)), rng.normal(size=(2, PIXELS))
    misfit = Misfit(0.0, rng.normal(size=PIXELS), rng.uniform(0.1, 1.0, PIXELS))
    at_pixel = np.zeros((PIXELS, KNOTS))
    np.put_along_axis(at_pixel, knots, weights, axis=1)
    dense = np.hstack((scaled.T, by_level[0, :, None] * at_pixel, by_level[1, :, None] * at_pixel))
    of_levels, of_others = rng.uniform(0.5, 5.0, (2, KNOTS)), rng.uniform(0.5, 2.0, OTHERS)
    normal = (scaled * misfit.weight) @ scaled.T + np.diag(of_others)
    equations = eliminate_levels(
        scaled, normal, AtKnots.of(knots, weights), by_level, misfit, of_levels
    )
    values = rng.normal(size=(2, KNOTS))
    values[:, FIRST_UNUSED:] = 0.0
    return Problem(equations, misfit, dense, np.append(of_others, of_levels), values)


def test_the_covariance_of_other_parameters_is_that_of_dense_equations(problem: Problem) -> None:
    expected = np.linalg.inv(problem.normal)
    inverse = np.linalg.inv(problem.equations.normal)
    assert np.allclose(inverse, expected[:OTHERS, :OTHERS], rtol=1e-9)
    variances = np.diag(expected)[OTHERS:][problem.equations.used]
    assert np.allclose(problem.equations.variances(), variances, rtol=1e-9)


def test_a_step_is_that_of_dense_equations(problem: Problem) -> None:
    expected = np.linalg.solve(problem.normal, problem.gradient)
    equations = problem.equations
    of_levels = equations.gradient_of_levels(problem.misfit.score, problem.values)
    half = equations.half_solved(of_levels)
    reduced = equations.scaled @ problem.misfit.score - equations.half_mixed.T @ half
    step = np.asarray(np.linalg.solve(equations.normal, reduced), dtype=np.float64)
    values = equations.step_of_levels(half, step)
    assert np.allclose(step, expected[:OTHERS], atol=1e-10)
    assert np.allclose(values.ravel(), expected[OTHERS:], atol=1e-10)
    assert not values[:, FIRST_UNUSED:].any()


def test_the_part_that_levels_explain_is_their_projection(problem: Problem) -> None:
    equations, weight = problem.equations, problem.misfit.weight
    of_levels = problem.dense[:, OTHERS:][:, equations.used]
    own = (of_levels * weight[:, None]).T @ of_levels + np.diag(equations.precision)
    mixed = (equations.scaled * weight) @ of_levels
    rows = equations.scaled - mixed @ np.linalg.solve(own, of_levels.T)
    assert np.allclose(equations.rows(), rows, atol=1e-12)
    arc, of_pose = np.arange(PIXELS) // 100, rows[:6].T
    taken = 0.0
    for number in range(4):
        part = (of_pose * weight[:, None])[arc == number].T @ of_levels[arc == number]
        taken += float(np.trace(part @ np.linalg.solve(own, part.T)))
    assert equations.scatter_explained(of_pose, weight, arc) == pytest.approx(taken, rel=1e-10)
