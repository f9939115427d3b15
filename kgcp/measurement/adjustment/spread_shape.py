"""Whether a point spread is skew, or of another kurtosis than a Gaussian, from residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.normal_equations import Unknowns, normal_matrix
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.image_model.blurred_plate import kurtosis_row
from kgcp.measurement.image_model.edge_terms import skew_rows
from kgcp.measurement.image_model.photometry import SHAPE_PARAMS, SKEW_PARAMS, Param
from kgcp.measurement.image_model.ray_plate import views_of

_SKEW_SD_PX3 = 1.0  # skewness 0.6 of a spread of 1.2 px
# Defocus alone has an excess kurtosis of −1, with a pixel and a lens's own blur −0.4 to −0.7. A
# weaker prior makes rings of R < 13 px worse.
_KURTOSIS_SD = 0.5
SHAPE_PRECISIONS = np.array([_SKEW_SD_PX3**-2] * len(SKEW_PARAMS) + [_KURTOSIS_SD**-2])
"""Inverse a-priori variances of `SHAPE_PARAMS`."""
# χ² of four degrees of freedom: the 98 targets of six flights of `benchmarks.accuracy` without skew
# have 13 at most, the 14 of light/lens 35 and more.
_SKEW_CHI2 = 25.0
# χ² of one degree of freedom: 88 fits in focus and in even light have 10 at most, those of a coarse
# renderer 27. Blurred to discs of 1 px radius by defocus, rings of R ≥ 19 px have 19 to 132; of
# 1.5 px, rings of all sizes 19 and more. By a curve that is not known, tone and sharpening stand in
# for defocus of up to 2 px, and a kurtosis may stand in for the wrong base of the curve.
_KURTOSIS_CHI2 = 16.0
_KURTOSIS_CHI2_BY_UNKNOWN_TONE = 40.0
KURTOSIS_CHI2_WITH_LEVELS = 40.0
"""χ² from which on kurtosis is free beside levels that vary.

Over the right base of the tone curve, 32 rings in focus under shadows have 21 at most, and 31 under
highlights 35 but for one of 83. Out of focus by 2 px, those of R ≥ 28 px have 140 and more, and
most smaller ones more than this.
"""


def shape_needed(fit: TargetFit) -> list[int]:
    """Return which parameters of the point spread's shape residuals ask for (score tests).

    Behind a lens whose spread is skew, its kurtosis is not that of a Gaussian either. Levels that
    vary would take part of a skew that is not asked for: with them it always is, which costs next
    to nothing (43 plates under shadows: errors and deviations the same within 5 %). Kurtosis beside
    them is asked for by `KURTOSIS_CHI2_WITH_LEVELS`; otherwise it would let fits rest where they
    start (by 0.6 σ in a test).
    """
    if fit.sample.problem.window.binning > 1 or fit.unknowns.has_shape:
        return []
    if fit.level_equations is not None:
        return SKEW_PARAMS
    scaled = fit.scaled_jacobian
    by_shape = equations_by_shape(fit, scaled, normal_matrix(scaled, fit.misfit, fit.unknowns))
    score, own = by_shape.score, by_shape.normal
    if score[:-1] @ np.linalg.solve(own[:-1, :-1], score[:-1]) > _SKEW_CHI2:
        return SHAPE_PARAMS
    is_unknown = fit.sample.problem.tone.is_unknown
    least = _KURTOSIS_CHI2_BY_UNKNOWN_TONE if is_unknown else _KURTOSIS_CHI2
    return [int(Param.KURTOSIS)] if score[-1] ** 2 > least * own[-1, -1] else []


class ShapeEquations(NamedTuple):
    """Normal equations of skew and kurtosis, with all parameters of a fit eliminated."""

    score: FloatArray  # (5,): derivatives of the log-likelihood
    normal: FloatArray  # (5, 5): without priors
    displacement: FloatArray  # (p, 5): of the free parameters, if the shape is left out


def equations_by_shape(fit: TargetFit, scaled: FloatArray, normal: FloatArray) -> ShapeEquations:
    """Return the equations of a shape that a fit has left out.

    Parameters
    ----------
    scaled : (p, n) array
        Jacobian of the free parameters, in units of the noise.
    normal : (p, p) array
        Their normal matrix.
    """
    rows = _by_shape(fit) / fit.sd
    weighted = rows * fit.misfit.weight
    mixed = scaled @ weighted.T
    displacement = np.asarray(np.linalg.solve(normal, mixed), np.float64)
    own = weighted @ rows.T - mixed.T @ displacement
    return ShapeEquations(rows @ fit.misfit.score, own, displacement)


def _by_shape(fit: TargetFit) -> FloatArray:
    """Return the derivatives (5, n) of the grey values by skew and kurtosis; the rest is known."""
    sample, parameters, share = fit.sample, fit.parameters, fit.prediction.share
    views, blur = views_of(parameters.matrix, sample.rays), parameters.blur
    skew = skew_rows(views, blur.total_covariance, sample.incidence)
    kurtosis = kurtosis_row(share, parameters.matrix, sample.rays, blur.vector, sample.incidence)
    rows = np.vstack((skew, kurtosis))
    return sample.photometry.level_changes(share, parameters.light, rows)


def with_shape(unknowns: Unknowns, shape: list[int]) -> Unknowns:
    """Return the unknowns with some parameters of the point spread's shape among them."""
    free = np.sort(np.append(unknowns.free, shape))
    precision = unknowns.precision.copy()
    precision[SHAPE_PARAMS] = SHAPE_PRECISIONS
    return Unknowns(free, unknowns.mean, precision, precision[free])
