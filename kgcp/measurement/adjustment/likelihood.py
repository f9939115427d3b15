"""Which of two fits of one target is the likelier one.

Every fit has pixels and noise of its own, so that sums over its pixels do not compare with those of
another fit. Both are held against the same pixels therefore: those of either, in turn. A fit of
more unknowns comes nearer to any pixels; Laplace's approximation of the evidence takes off what
that is worth: of a prior, only the share that the pixels leave counts.
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
    if is_even:  # where levels vary, both have as many unknowns
        advantage += _loss_of_volume(other) - _loss_of_volume(fit)
    return advantage


def _loss_of_volume(fit: TargetFit) -> float:
    """Return the negative logarithm of the priors' share that a fit leaves, up to a constant."""
    normal = normal_matrix(fit.scaled_jacobian, fit.misfit, fit.unknowns)
    precision = fit.unknowns.free_precision
    of_priors = float(np.sum(np.log(precision[precision > 0.0])))
    return 0.5 * (float(np.linalg.slogdet(normal)[1]) - of_priors)


def _loss(fit: TargetFit, sample: Sample) -> float:
    """Return the negative log-likelihood of a sample's pixels by a fit, the priors included.

    Noise is what the fit leaves there, which is part of the likelihood.
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
