"""Bends of a sheet that differ between photographs: paper on a board that is turned, or a panel.

A bend common to all photographs belongs to the field's shape. The differences are a random effect:
heights of second order in each photograph, whose standard deviation is estimated from all of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from kgcp.geometry.arrays import FloatArray
from kgcp.network.covariance import bend_cofactors
from kgcp.network.equations import computed, network_rows, view_rows
from kgcp.network.records import BendPrior, Estimate, Network, Solution

_FALSE_ALARM = 0.001  # probability that a rigid board is taken for one that bends
# Lower limit of the determined share of all bends: it keeps the estimate of their standard
# deviation finite.
_MIN_DETERMINED_SHARE = 0.02


def bend_shapes(points: FloatArray) -> FloatArray:
    """Return the heights (m, 3) of a plane's points in three bends of second order, each of RMS 1.

    They are orthogonal to each other and to the heights that a change of the pose causes.
    """
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    x, y = (flat / np.abs(flat).max()).T
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=1)
    return np.asarray(np.linalg.qr(terms)[0][:, 3:] * np.sqrt(len(points)))


def bend_displacements(network: Network, estimate: Estimate) -> FloatArray:
    """Return the displacements (n, 2) of the discs' images by the bends."""
    flat = replace(network, bends=None)
    return computed(network, estimate) - computed(flat, estimate)


def first_bends(network: Network, solution: Solution, shapes: FloatArray) -> BendPrior | None:
    """Return start values of the bends' prior; None if bends are not significant.

    Parameters
    ----------
    network : Network
        Without bends, and with covariances of the discs that agree with the residuals.
    """
    trial = replace(network, bends=BendPrior(shapes, 1.0))
    views, count = len(network.view_camera), shapes.shape[1]
    estimate = solution.estimate.with_zero_bends(count)
    explained, amounts = 0.0, []
    for view in view_rows(trial, network_rows(trial, estimate, solution.weights)):
        basis = np.linalg.qr(view.by_pose[:, :6])[0]
        by_bend = view.by_pose[:, 6:] - basis @ (basis.T @ view.by_pose[:, 6:])
        score = by_bend.T @ view.residuals
        amount = np.linalg.lstsq(by_bend, view.residuals)[0]
        explained += float(score @ amount)
        amounts.append(amount)
    if explained <= stats.chi2.ppf(1.0 - _FALSE_ALARM, views * count):
        return None
    return BendPrior(shapes, float(np.sqrt(np.mean(np.square(amounts)))))


def next_bends(network: Network, solution: Solution, bends: BendPrior) -> BendPrior:
    """Return the bends' prior with its standard deviation updated.

    This is one step of MacKay (1992): the new variance is the sum of the squared amounts divided by
    the number of bends that the photographs determine. Its fixed point maximises the restricted
    likelihood.
    """
    cofactors = bend_cofactors(network, solution)
    determined = float(np.sum(1.0 - cofactors / bends.sd**2))
    least = _MIN_DETERMINED_SHARE * cofactors.size
    squares = float(np.sum(solution.estimate.bends**2))
    return BendPrior(bends.shapes, float(np.sqrt(squares / max(determined, least))))
