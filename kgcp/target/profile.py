"""How a blurred disc looks: its coverage under Gaussian blur, for any ratio of radius to blur.

A white disc of radius r, blurred by a Gaussian, has at distance ρ from its centre the level
P(|ρ + ε| ≤ r): for isotropic blur the distribution function of a noncentral χ² with two degrees of
freedom, 1 − Q₁(ρ/σ, r/σ) with Marcum's Q. On a tilted plate the blur is anisotropic, so the
probability is integrated here directly: over the chords of the disc, with the inner integral (along
the radial direction, conditioned on the tangential one) in closed form. Where the disc is large
against the blur a few Gauss-Hermite nodes over the tangential direction are enough, because the
edge is then nearly straight within the blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.special import ndtr

from kgcp.geometry.arrays import FloatArray

_INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


class Quadrature(IntEnum):
    """Rules of integration, cheapest that holds 3e-4 of the contrast; see `quadrature_for`.

    `EDGE` integrates nothing: see `kgcp.target.bent_edge`.
    """

    CHORDS_4 = 0
    CHORDS_6 = 1
    CHORDS_9 = 2
    HERMITE_5 = 3
    EDGE = 4


_LARGEST_RATIO = {
    Quadrature.CHORDS_4: 1.6,
    Quadrature.CHORDS_6: 2.6,
    Quadrature.CHORDS_9: 4.0,
    Quadrature.HERMITE_5: 6.0,
}


def quadrature_for(radius_over_sigma: float) -> Quadrature:
    """Return the cheapest rule whose error stays below 3e-4 of the contrast."""
    fitting = (rule for rule, limit in _LARGEST_RATIO.items() if radius_over_sigma <= limit)
    return next(fitting, Quadrature.EDGE)


@dataclass(frozen=True, slots=True)
class Coverage:
    """Blurred coverage of discs at n points, and its derivatives.

    Attributes
    ----------
    value : (n,) array
        0 outside, 1 inside.
    d_rho, d_var_radial, d_var_tangential, d_covariance : (n,) array
        Derivatives with respect to the arguments of `blurred_disc`.
    """

    value: FloatArray
    d_rho: FloatArray
    d_var_radial: FloatArray
    d_var_tangential: FloatArray
    d_covariance: FloatArray


def blurred_disc(
    rho: FloatArray,
    radius: FloatArray,
    var_radial: FloatArray,
    var_tangential: FloatArray,
    covariance: FloatArray,
    rule: Quadrature,
) -> Coverage:
    """Return the coverage of discs under anisotropic Gaussian blur.

    Parameters
    ----------
    rho : (n,) array
        Distances of the points from the discs' centres.
    radius : (n,) array
        Radii of the discs, in the same unit.
    var_radial, var_tangential, covariance : (n,) array
        The blur's covariance in radial and tangential direction at the point, unit squared.
    rule : Quadrature
        See `quadrature_for`; not `EDGE`.
    """
    integrate = _over_chords if rule <= Quadrature.CHORDS_9 else _over_hermite
    return integrate(rho, radius, var_radial, var_tangential, covariance, *_NODES[rule])


def blurred_level(
    rho: FloatArray,
    radius: FloatArray,
    var_radial: FloatArray,
    var_tangential: FloatArray,
    covariance: FloatArray,
    rule: Quadrature,
) -> FloatArray:
    """Return the value of `blurred_disc` alone, at less than half its cost."""
    nodes, weights = _NODES[rule]
    sd = np.sqrt(_conditional_variance(var_radial, var_tangential, covariance))
    sd_tangential = np.sqrt(var_tangential)
    if rule <= Quadrature.CHORDS_9:
        y, half_chord, weight = _chord_nodes(radius, sd_tangential, nodes, weights)
        centre = rho[:, None] + (covariance / var_tangential)[:, None] * y
        inner, outer = (-half_chord - centre) / sd[:, None], (half_chord - centre) / sd[:, None]
        return np.asarray((weight * (ndtr(outer) - ndtr(inner))).sum(axis=1))
    value = np.zeros_like(rho)
    for node, weight in zip(nodes, weights, strict=True):
        half_chord = np.sqrt(np.maximum(radius * radius - var_tangential * node**2, 1e-12))
        value += weight * ndtr((half_chord - rho - covariance / sd_tangential * node) / sd)
    return value


def density(z: FloatArray) -> FloatArray:
    """Return the standard normal density."""
    value: FloatArray = np.exp(-0.5 * z * z) * _INV_SQRT_2PI
    return value


def _conditional_variance(
    var_radial: FloatArray, var_tangential: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the variance of the radial blur once the tangential one is known."""
    return np.maximum(var_radial - covariance * covariance / var_tangential, 1e-6 * var_radial)


def _over_hermite(
    rho: FloatArray,
    radius: FloatArray,
    var_radial: FloatArray,
    var_tangential: FloatArray,
    covariance: FloatArray,
    nodes: FloatArray,
    weights: FloatArray,
) -> Coverage:
    conditional = _conditional_variance(var_radial, var_tangential, covariance)
    sd, sd_tangential = np.sqrt(conditional), np.sqrt(var_tangential)
    slope = covariance / sd_tangential
    value = np.zeros_like(rho)
    first, second, by_node, by_chord = (np.zeros_like(rho) for _ in range(4))
    for node, weight in zip(nodes, weights, strict=True):
        half_chord = np.sqrt(np.maximum(radius * radius - var_tangential * node**2, 1e-12))
        z = (half_chord - rho - slope * node) / sd
        slope_there = weight * density(z)
        value += weight * ndtr(z)
        first += slope_there
        second += slope_there * z
        by_node += slope_there * node
        by_chord += slope_there * (node**2) / half_chord
    d_conditional = -second / (2.0 * conditional)
    d_slope = -by_node / sd
    ratio = covariance / var_tangential
    return Coverage(
        value=value,
        d_rho=-first / sd,
        d_var_radial=d_conditional,
        d_var_tangential=-by_chord / (2.0 * sd)
        + d_conditional * ratio * ratio
        - d_slope * ratio / (2.0 * sd_tangential),
        d_covariance=-2.0 * d_conditional * ratio + d_slope / sd_tangential,
    )


def _chord_nodes(
    radius: FloatArray, sd_tangential: FloatArray, nodes: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions, half lengths and weights of the chords of n discs, each (n, k)."""
    y, half_chord = radius[:, None] * nodes, radius[:, None] * weights
    weight = half_chord * density(y / sd_tangential[:, None])
    weight *= (np.pi / (len(nodes) + 1)) / sd_tangential[:, None]
    return y, half_chord, weight


def _over_chords(
    rho: FloatArray,
    radius: FloatArray,
    var_radial: FloatArray,
    var_tangential: FloatArray,
    covariance: FloatArray,
    nodes: FloatArray,
    weights: FloatArray,
) -> Coverage:
    conditional = _conditional_variance(var_radial, var_tangential, covariance)[:, None]
    sd, sd_tangential = np.sqrt(conditional), np.sqrt(var_tangential)[:, None]
    ratio = covariance / var_tangential
    y, half_chord, weight = _chord_nodes(radius, sd_tangential[:, 0], nodes, weights)
    centre = rho[:, None] + ratio[:, None] * y
    z_far, z_near = (half_chord - centre) / sd, (-half_chord - centre) / sd
    density_far, density_near = density(z_far), density(z_near)
    share = weight * (ndtr(z_far) - ndtr(z_near))
    gradient = weight * (density_far - density_near) / sd
    second = (weight * (density_far * z_far - density_near * z_near)).sum(axis=1)
    d_conditional = -second / (2.0 * conditional[:, 0])
    d_ratio = -(gradient * y).sum(axis=1)
    stretch = ((y / sd_tangential) ** 2 - 1.0) / (2.0 * sd_tangential**2)
    return Coverage(
        value=share.sum(axis=1),
        d_rho=-gradient.sum(axis=1),
        d_var_radial=d_conditional,
        d_var_tangential=(share * stretch).sum(axis=1)
        + d_conditional * ratio * ratio
        - d_ratio * ratio / var_tangential,
        d_covariance=-2.0 * d_conditional * ratio + d_ratio / var_tangential,
    )


def _hermite(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights over the standard normal distribution."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return nodes, weights / weights.sum()


def _chords(count: int) -> tuple[FloatArray, FloatArray]:
    """Return positions and half lengths of a unit disc's chords at equal steps of the angle.

    With y = r sin α the integrand is smooth and periodic in α and vanishes at the ends, so equal
    steps converge exponentially.
    """
    angle = np.pi * np.arange(1, count + 1) / (count + 1) - 0.5 * np.pi
    return np.sin(angle), np.cos(angle)


_NODES = {
    Quadrature.CHORDS_4: _chords(4),
    Quadrature.CHORDS_6: _chords(6),
    Quadrature.CHORDS_9: _chords(9),
    Quadrature.HERMITE_5: _hermite(5),
}
