"""The equations of one step of the adjustment: what is unknown, and how it is moved."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from kgcp.compiled import compiled
from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.target.light import PARAM_COUNT
from kgcp.target.noise import Misfit
from kgcp.target.parameters import Parameters

_LIKE_A_TILT = 0.07  # of the distance: so great a change is held back like a tilt of 1 rad, at most


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Which parameters are estimated, and what is known of them beforehand.

    Attributes
    ----------
    free : (p,) array of int
        Estimated parameters, by `Param`.
    mean, precision : (19,) array
        Independent normal priors on the nuisance parameters; precision 0: none.
    free_precision : (p,) array
        Of the estimated parameters.
    """

    free: IndexArray
    mean: FloatArray
    precision: FloatArray
    free_precision: FloatArray

    def penalty(self, parameters: Parameters) -> float:
        """Return the priors' part of the negative log-likelihood."""
        deviation = parameters.vector - self.mean
        return float(0.5 * (self.precision * deviation) @ deviation)


def normal_matrix(scaled: FloatArray, current: Misfit, unknowns: Unknowns) -> FloatArray:
    """Return the normal matrix for a Jacobian (p, n) in units of the noise.

    Of a plate that a step has turned edge-on it is not finite, and cannot be solved.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        normal = (scaled * current.weight) @ scaled.T
    normal.flat[:: len(normal) + 1] += unknowns.free_precision
    return normal


def propose(
    scaled: FloatArray,
    normal: FloatArray,
    current: Misfit,
    parameters: Parameters,
    unknowns: Unknowns,
    damping: float,
) -> tuple[FloatArray, float]:
    """Return a step (19,) and the gain that it promises.

    Raises
    ------
    Rejection
        `POOR_FIT` if the equations cannot be solved.
    """
    pull = unknowns.precision * (unknowns.mean - parameters.vector)
    gradient = scaled @ current.score + pull[unknowns.free]
    damped = normal.copy()
    damped.flat[:: len(normal) + 1] += damping * _stiffness(normal, parameters, unknowns)
    _, solution, failure = dposv(damped, gradient)  # LAPACK itself: they are small and many
    promised = 0.5 * float(gradient @ solution)
    if failure or not math.isfinite(promised):
        raise Rejection(Reason.POOR_FIT, "singular normal equations")
    step = np.zeros(PARAM_COUNT)
    step[unknowns.free] = solution
    return step, promised


def _stiffness(normal: FloatArray, parameters: Parameters, unknowns: Unknowns) -> FloatArray:
    """Return what damping holds parameters (p,) back by: the diagonal of the normal matrix.

    A plate seen from straight above hardly changes with its tilt. Unless that is held back like
    the distance, every step turns it over, fails, and the distance stays where it is.
    """
    stiffness = normal.diagonal().copy()
    if unknowns.free[0] == 0:
        reach_m = _LIKE_A_TILT * parameters.pose.distance_m
        stiffness[3:6] = np.maximum(stiffness[3:6], reach_m * reach_m * stiffness[2])
    return stiffness


@compiled
def scaled_rows(jacobian: FloatArray, rows: IndexArray, sd: FloatArray) -> FloatArray:
    """Return some rows of a Jacobian (p, n), in units of the noise (n,)."""
    scaled, per_sd = np.empty((len(rows), len(sd))), 1.0 / sd
    for k in range(len(rows)):
        for i in range(len(sd)):
            scaled[k, i] = jacobian[rows[k], i] * per_sd[i]
    return scaled
