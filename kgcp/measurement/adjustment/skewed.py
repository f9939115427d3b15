"""Whether a point spread is skew, from the residuals of a fit that takes it for symmetric."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.normal_equations import Unknowns, normal_matrix
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.image_model.edge_terms import skew_rows
from kgcp.measurement.image_model.photometry import SKEW_PARAMS
from kgcp.measurement.image_model.ray_plate import views_of

_SKEW_SD_PX3 = 1.0  # skewness 0.6 of a spread of 1.2 px
# χ² of four degrees of freedom: the 98 targets of six flights of `benchmarks.accuracy` without skew
# have 13 at most, the 14 of light/lens 35 and more.
_SKEW_CHI2 = 25.0


def needs_skew(fit: TargetFit) -> bool:
    """Tell whether third moments would take more of the residuals than chance (score test).

    Levels that vary would take part of a skew that is not asked for: with them it always is, which
    costs next to nothing (43 plates under shadows: errors and deviations the same within 5 %).
    """
    if fit.sample.problem.window.binning > 1 or fit.unknowns.free[-1] >= SKEW_PARAMS[0]:
        return False
    if fit.level_equations is not None:
        return True
    by_skew, scaled = _by_skew(fit) / fit.sd, fit.scaled_jacobian
    normal = normal_matrix(scaled, fit.misfit, fit.unknowns)
    score, weighted = by_skew @ fit.misfit.score, by_skew * fit.misfit.weight
    mixed = scaled @ weighted.T
    own = weighted @ by_skew.T - mixed.T @ np.linalg.solve(normal, mixed)
    return bool(score @ np.linalg.solve(own, score) > _SKEW_CHI2)


def _by_skew(fit: TargetFit) -> FloatArray:
    """Return the derivatives (4, n) of the grey values by the skew; the others are known."""
    sample, parameters = fit.sample, fit.parameters
    views = views_of(parameters.matrix, sample.rays)
    rows = skew_rows(views, parameters.blur.total_covariance, sample.incidence)
    return sample.photometry.level_changes(fit.prediction.share, parameters.light, rows)


def with_skew(unknowns: Unknowns) -> Unknowns:
    """Return the unknowns with the third moments among them."""
    free = np.append(unknowns.free, SKEW_PARAMS)
    precision = unknowns.precision.copy()
    precision[SKEW_PARAMS] = _SKEW_SD_PX3**-2
    return Unknowns(free, unknowns.mean, precision, precision[free])
