"""The unknowns of the adjustment, and the normal equations of one step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dposv

from kgcp.errors import Reason, Rejection
from kgcp.geometry._jit import compiled, reassociated
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.adjustment.parameters import Parameters
from kgcp.measurement.image_model.noise import Misfit
from kgcp.measurement.image_model.photometry import PARAM_COUNT, SHAPE_PARAMS

TILT_LIKE_DISTANCE = 0.07
"""A tilt of 1 rad is damped at least like a change of the distance by this share."""

_DEPTH, _FIRST_TURN, _LAST_TURN = 2, 3, 5  # indices of parameters


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Which parameters are estimated, and what is known of them beforehand."""

    free: IndexArray  # (p,): estimated parameters, by `Param`
    # (27,): independent normal priors on the nuisance parameters; precision 0: none
    mean: FloatArray
    precision: FloatArray
    free_precision: FloatArray  # (p,): of the estimated parameters

    @property
    def has_shape(self) -> bool:
        """Whether skew or kurtosis of the point spread are estimated."""
        return bool(self.free[-1] >= SHAPE_PARAMS[0])

    def penalty(self, parameters: Parameters) -> float:
        """Return the priors' part of the negative log-likelihood."""
        return _penalty(parameters.vector, self.mean, self.precision)

    def step_of(self, solution: FloatArray) -> FloatArray:
        """Return the step (27,) of all parameters, given that of the estimated ones (p,)."""
        step = np.zeros(PARAM_COUNT)
        step[self.free] = solution
        return step


def normal_matrix(scaled: FloatArray, current: Misfit, unknowns: Unknowns) -> FloatArray:
    """Return the normal matrix for a Jacobian (p, n) in units of the noise.

    It is not finite, and cannot be solved, if a step has turned the plate edge-on.
    """
    return weighted_products(scaled, current.weight, unknowns.free_precision)


@reassociated
def weighted_products(scaled: FloatArray, weight: FloatArray, precision: FloatArray) -> FloatArray:
    """Return the products of all rows, weighted and summed over pixels, plus a diagonal precision.

    Rows are taken two by two. That takes half the time of a general product, which computes both
    halves of the symmetric result.
    """
    rows, pixels = scaled.shape
    normal, first, second = np.empty((rows, rows)), np.empty(pixels), np.empty(pixels)
    for k in range(0, rows, 2):
        k2 = min(k + 1, rows - 1)
        for i in range(pixels):
            first[i], second[i] = scaled[k, i] * weight[i], scaled[k2, i] * weight[i]
        for m in range(k, rows, 2):
            m2 = min(m + 1, rows - 1)
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for i in range(pixels):
                a += first[i] * scaled[m, i]
                b += first[i] * scaled[m2, i]
                c += second[i] * scaled[m, i]
                d += second[i] * scaled[m2, i]
            normal[k, m] = normal[m, k] = a
            normal[k, m2] = normal[m2, k] = b
            normal[k2, m] = normal[m, k2] = c
            normal[k2, m2] = normal[m2, k2] = d
    for k in range(rows):
        normal[k, k] += precision[k]
    return normal


class Equations(Protocol):
    """The normal equations of one linearisation."""

    def proposed(
        self, current: Misfit, parameters: Parameters, damping: float
    ) -> tuple[Parameters, float]:
        """Return the parameters after a damped step, and the gain that the step promises.

        Raises
        ------
        Rejection
            `POOR_FIT` if the equations cannot be solved.
        """


@dataclass(frozen=True, slots=True, eq=False)
class PlainEquations:
    """The equations of pose, blur and light."""

    scaled: FloatArray  # (p, n): Jacobian, in units of the noise
    normal: FloatArray  # (p, p): priors included
    unknowns: Unknowns

    @staticmethod
    def of(
        jacobian: FloatArray, sd: FloatArray, current: Misfit, unknowns: Unknowns
    ) -> PlainEquations:
        """Make the equations of a Jacobian by all parameters, with the noise (n,)."""
        scaled = scaled_rows(jacobian, unknowns.free, sd)
        return PlainEquations(scaled, normal_matrix(scaled, current, unknowns), unknowns)

    def proposed(
        self, current: Misfit, parameters: Parameters, damping: float
    ) -> tuple[Parameters, float]:
        """Return the parameters after a damped step, and the gain that the step promises."""
        unknowns = self.unknowns
        damped, gradient = _damped_equations(
            self.scaled,
            current.score,
            self.normal,
            damping,
            parameters.matrix[:, 3],
            parameters.vector,
            unknowns.mean,
            unknowns.precision,
            unknowns.free,
        )
        solution, promised = solve_damped(damped, gradient)
        return parameters.moved(unknowns.step_of(solution)), promised


def solve_damped(
    damped: FloatArray, gradient: FloatArray, eliminated_gain: float = 0.0
) -> tuple[FloatArray, float]:
    """Return the solution of symmetric equations, and the gain in log-likelihood that it promises.

    `eliminated_gain` is the gain of unknowns that were eliminated.

    Raises
    ------
    Rejection
        `POOR_FIT` if the equations cannot be solved.
    """
    _, solution, failure = dposv(damped.T, gradient)  # LAPACK directly: many small systems
    promised = 0.5 * float(gradient @ solution) + eliminated_gain
    if failure or not math.isfinite(promised):
        raise Rejection(Reason.POOR_FIT, "singular normal equations")
    return solution, promised


@compiled
def _damped_equations(
    scaled: FloatArray,
    score: FloatArray,
    normal: FloatArray,
    damping: float,
    translation_m: FloatArray,
    vector: FloatArray,
    mean: FloatArray,
    precision: FloatArray,
    free: IndexArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the damped normal matrix (p, p), and the gradient (p,) with the part of the priors.

    The image of a plate that is seen frontally hardly changes with its tilt. If the tilt were not
    damped like the distance, every step would turn the plate over and fail, and the distance would
    never change.
    """
    damped, gradient = normal.copy(), scaled @ score
    reach_m = TILT_LIKE_DISTANCE * math.sqrt((translation_m**2).sum())
    for k in range(len(free)):
        row, stiffness = free[k], normal[k, k]
        if _FIRST_TURN <= row <= _LAST_TURN:
            stiffness = max(stiffness, reach_m * reach_m * normal[_DEPTH, _DEPTH])
        damped[k, k] += damping * stiffness
        gradient[k] += precision[row] * (mean[row] - vector[row])
    return damped, gradient


@compiled
def _penalty(vector: FloatArray, mean: FloatArray, precision: FloatArray) -> float:
    total = 0.0
    for k in range(len(vector)):
        total += 0.5 * precision[k] * (vector[k] - mean[k]) ** 2
    return total


@compiled
def scaled_rows(jacobian: FloatArray, rows: IndexArray, sd: FloatArray) -> FloatArray:
    """Return some rows of a Jacobian (p, n), in units of the noise (n,)."""
    scaled, per_sd = np.empty((len(rows), len(sd))), 1.0 / sd
    for k in range(len(rows)):
        for i in range(len(sd)):
            scaled[k, i] = jacobian[rows[k], i] * per_sd[i]
    return scaled
