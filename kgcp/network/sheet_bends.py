"""How a sheet bends from photograph to photograph: paper on a board that is turned, or a panel.

A bend that is the same in all photographs is the field's own shape. What differs is a random
effect: heights of second order in each photograph, whose standard deviation the photographs tell.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from kgcp.geometry.arrays import FloatArray
from kgcp.network.covariance import bend_cofactors
from kgcp.network.equations import computed, view_rows
from kgcp.network.records import BendPrior, Estimate, Network, Solution

_BY_CHANCE = 0.001  # as often boards that do not bend are taken for some that do
_LEAST_SHARE = 0.02  # of the bends of all photographs, that must be determined


def bend_shapes(points: FloatArray) -> FloatArray:
    """Return the heights (m, 3) of a plane's points in bends of second order, each of RMS 1.

    They are orthogonal to each other and to what a pose does.
    """
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    x, y = (flat / np.abs(flat).max()).T
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=1)
    return np.asarray(np.linalg.qr(terms)[0][:, 3:] * np.sqrt(len(points)))


def bend_displacements(network: Network, estimate: Estimate) -> FloatArray:
    """Return by how much the bends displace the images of the discs (n, 2)."""
    flat = replace(network, bends=None)
    return computed(network, estimate) - computed(flat, estimate)


def first_bends(network: Network, solution: Solution, shapes: FloatArray) -> BendPrior | None:
    """Return the bends to begin with; None: they explain no more than by chance.

    Parameters
    ----------
    network : Network
        Without bends, with covariances of the discs that fit the residuals.
    """
    trial = replace(network, bends=BendPrior(shapes, 1.0))
    views, count = len(network.view_camera), shapes.shape[1]
    estimate = solution.estimate.unbent(count)
    explained, amounts = 0.0, []
    for view in view_rows(trial, estimate, solution.weights):
        basis = np.linalg.qr(view.by_pose[:, :6])[0]
        by_bend = view.by_pose[:, 6:] - basis @ (basis.T @ view.by_pose[:, 6:])
        score = by_bend.T @ view.residuals
        amount = np.linalg.lstsq(by_bend, view.residuals)[0]
        explained += float(score @ amount)
        amounts.append(amount)
    if explained <= stats.chi2.ppf(1.0 - _BY_CHANCE, views * count):
        return None
    return BendPrior(shapes, float(np.sqrt(np.mean(np.square(amounts)))))


def next_bends(network: Network, solution: Solution, bends: BendPrior) -> BendPrior:
    """Return the bends with the standard deviation that those of the photographs have.

    One step of MacKay (1992): the sum of their squares over how many of them are determined, which
    is where the restricted likelihood is greatest once it changes no more.
    """
    cofactors = bend_cofactors(network, solution)
    determined = float(np.sum(1.0 - cofactors / bends.sd**2))
    least = _LEAST_SHARE * cofactors.size
    squares = float(np.sum(solution.estimate.bends**2))
    return BendPrior(bends.shapes, float(np.sqrt(squares / max(determined, least))))
