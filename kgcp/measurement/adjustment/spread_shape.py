"""Tests whether a point spread is skew, or has another kurtosis than a Gaussian, from residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.adjustment.normal_equations import Unknowns, normal_matrix
from kgcp.measurement.adjustment.solver import TargetFit
from kgcp.measurement.image_model.blurred_plate import kurtosis_row
from kgcp.measurement.image_model.edge_terms import skew_rows
from kgcp.measurement.image_model.photometry import SHAPE_PARAMS, SKEW_PARAMS, Param
from kgcp.measurement.image_model.ray_plate import plate_views

_SKEW_SD_PX3 = 1.0  # of third cumulants: a skewness of 0.6 for a spread of σ = 1.2 px
# Defocus alone has an excess kurtosis of −1; with a pixel and a lens's own blur it is −0.4 to −0.7.
# A weaker prior makes rings of R < 13 px worse.
_KURTOSIS_SD = 0.5
SHAPE_PRECISIONS = np.array([_SKEW_SD_PX3**-2] * len(SKEW_PARAMS) + [_KURTOSIS_SD**-2])
"""Inverse a-priori variances of `SHAPE_PARAMS`."""
# A larger χ² (four degrees of freedom) says that the point spread is skew. Of 240 random rings of R
# 13 to 80 px without skew, in even light, one has more and none has 18. A skew that is left out
# displaces centres by about as many standard deviations as the root of its χ²: with a limit of 25,
# five of 101 behind comatic lenses had χ² of 18 to 25 and were 2.8 to 4.7 σ off.
_SKEW_CHI2 = 16.0
# A larger χ² (one degree of freedom) says that the point spread has a kurtosis. In focus and in
# even light, 88 fits have at most 10, those of a coarse renderer at most 27. With defocus to discs
# of 1 px radius, rings of R ≥ 19 px have 19 to 132; with 1.5 px, rings of all sizes have 19 and
# more. If the curve is unknown, tone and sharpening can imitate a defocus of up to 2 px, and a
# kurtosis can imitate the wrong base of the curve: the limit is higher.
_KURTOSIS_CHI2 = 16.0
_KURTOSIS_CHI2_BY_UNKNOWN_TONE = 40.0
KURTOSIS_CHI2_WITH_LEVELS = 40.0
"""χ² above which the kurtosis is free beside levels that vary.

In focus, over the right base of the tone curve, 32 rings under shadows have at most 21; 31 rings
under highlights have at most 35, except one with 83. Out of focus by 2 px, rings of R ≥ 28 px have
140 and more, and most smaller ones have more than this limit.
"""


def shape_needed(fit: TargetFit) -> list[int]:
    """Return which parameters of the point spread's shape must be free, by score tests.

    Skew comes with kurtosis: a lens whose point spread is skew has no Gaussian's kurtosis either.
    In bins a kurtosis says nothing, since they are squares and hide the tone curve.

    If levels vary, skew is always free, since levels would take up a part of it. That costs next to
    nothing: on 43 plates under shadows, errors and deviations are the same within 5 %. Kurtosis is
    then free only by `KURTOSIS_CHI2_WITH_LEVELS`; if it were always free, fits would stay near
    their start (0.6 σ off in a test).
    """
    is_binned = fit.sample.problem.window.binning > 1
    if fit.unknowns.has_shape:
        return []
    if fit.level_equations is not None:
        return [] if is_binned else SKEW_PARAMS
    scaled = fit.scaled_jacobian
    by_shape = equations_by_shape(fit, scaled, normal_matrix(scaled, fit.misfit, fit.unknowns))
    score, information = by_shape.score, by_shape.normal
    if score[:-1] @ np.linalg.solve(information[:-1, :-1], score[:-1]) > _SKEW_CHI2:
        return SHAPE_PARAMS
    if is_binned:
        return []
    is_unknown = fit.sample.problem.tone.is_unknown
    least = _KURTOSIS_CHI2_BY_UNKNOWN_TONE if is_unknown else _KURTOSIS_CHI2
    return [int(Param.KURTOSIS)] if score[-1] ** 2 > least * information[-1, -1] else []


class ShapeEquations(NamedTuple):
    """Normal equations of skew and kurtosis, with all parameters of a fit eliminated."""

    score: FloatArray  # (5,): derivatives of the log-likelihood
    normal: FloatArray  # (5, 5): without priors
    displacement: FloatArray  # (p, 5): of the free parameters, per unit of a shape that is left out


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
    """Return the derivatives (5, n) of the grey values by skew and kurtosis."""
    sample, parameters, share = fit.sample, fit.parameters, fit.prediction.share
    views, blur = plate_views(parameters.matrix, sample.rays), parameters.blur
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
