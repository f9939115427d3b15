"""Which of two fits of one target is the likelier one.

Every fit has its own pixels and noise, so that the sums over them cannot be compared. Therefore
both fits are compared on the same pixels: those of the one, then those of the other.

A fit with more unknowns comes nearer to any pixels. Laplace's approximation of the evidence allows
for that: it counts how much of the volume of its priors a fit leaves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kgcp.measurement.adjustment.normal_equations import normal_matrix
from kgcp.measurement.adjustment.pixels import Sample
from kgcp.measurement.adjustment.solver import TargetFit, negative_log_posterior, noise_of, predict
from kgcp.measurement.image_model.noise import misfit


def advantage_over(other: TargetFit, fit: TargetFit) -> float:
    """Return by how much the logarithm of the evidence is greater for `fit` than for `other`."""
    advantage = 0.5 * sum(
        _loss(other, sample) - _loss(fit, sample) for sample in (fit.sample, other.sample)
    )
    is_even = fit.level_equations is None and other.level_equations is None
    if is_even:  # where levels vary, both fits have the same number of unknowns
        advantage += _loss_of_volume(other) - _loss_of_volume(fit)
    return advantage


def advantage_on_own_pixels(fit: TargetFit, other: TargetFit) -> float:
    """Return by how much the log-likelihood of the pixels of `fit` is greater than by `other`.

    Unlike `advantage_over`, this leaves out what only `other` explains, such as the grey values of
    white that `fit` takes for clipped.
    """
    return _loss(other, fit.sample) - _loss(fit, fit.sample)


def _loss_of_volume(fit: TargetFit) -> float:
    """Return −log of the share of the priors' volume that a fit leaves, up to a constant."""
    normal = normal_matrix(fit.scaled_jacobian, fit.misfit, fit.unknowns)
    precision = fit.unknowns.free_precision
    of_priors = float(np.sum(np.log(precision[precision > 0.0])))
    return 0.5 * (float(np.linalg.slogdet(normal)[1]) - of_priors)


def _loss(fit: TargetFit, sample: Sample) -> float:
    """Return the negative log-likelihood of a sample's pixels under a fit, with the priors.

    The noise is estimated from the residuals of the fit there. It is part of the likelihood.
    """
    tone = fit.sample.problem.tone
    toned = replace(
        sample,
        problem=replace(sample.problem, tone=tone),
        photometry=replace(sample.photometry, tone=tone),
    )
    is_own = sample is fit.sample
    prediction = fit.prediction if is_own else predict(toned, fit.parameters)
    sd = noise_of(toned, prediction).sd
    current = misfit(sample.levels, prediction.levels, sd, sample.censoring)
    loss = negative_log_posterior(current, fit.unknowns, fit.parameters)
    return loss + float(np.sum(np.log(sd)))
