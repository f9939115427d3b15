"""Quadrature rules for blurred discs, and polynomials for the normal distribution.

The radii up to which each rule is used were found by comparison with the noncentral χ² distribution
(isotropic blur) and with 70 chords (anisotropic blur). The error of any number of chords is below
3e-4 of the contrast, and so is that of the closed form if the blur is isotropic. Otherwise the
closed form is off by up to 6e-4, under streaks of up to 8 px by 2e-3 (docs/method/image_model.md,
"Blurred discs"). tests/measurement/image_model/test_blurred_discs.py repeats the comparison.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from scipy.special import erfcx

from kgcp.geometry.arrays import FloatArray, IndexArray

FAR = 6.0  # in standard deviations; the tail beyond is below 1e-9
SQUARINGS = 5  # exp(−z²/2) is exp(−z²/64), squared five times: a short polynomial suffices
BEND = 0.3  # Mills' ratio is a short polynomial in t = 1 / (1 + BEND z)
_EXPONENTIAL_ORDER, _RATIO_ORDER = 6, 7  # both together are accurate to 3e-8


def _fitted(x: FloatArray, y: FloatArray, order: int) -> tuple[float, ...]:
    """Return the coefficients of a polynomial fit, the constant first."""
    return tuple(Chebyshev.fit(x, y, order).convert(kind=Polynomial).coef.tolist())


def _exponential() -> tuple[float, ...]:
    """Return the polynomial for exp(−q) with q = z²/2 / 2**SQUARINGS, for z up to FAR."""
    q = np.linspace(0.0, 0.5 * FAR**2 / 2**SQUARINGS, 2001)
    return _fitted(q, np.exp(-q), _EXPONENTIAL_ORDER)


def _tail_ratio() -> tuple[float, ...]:
    """Return the polynomial in t for Mills' ratio, for z from 0 to FAR."""
    low = 1.0 / (1.0 + BEND * FAR)
    t = 0.5 * (1.0 + low) + 0.5 * (1.0 - low) * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    ratio = math.sqrt(0.5 * math.pi) * erfcx((1.0 / t - 1.0) / BEND * math.sqrt(0.5))
    return _fitted(t, ratio, _RATIO_ORDER)


EXPONENTIAL = _exponential()
TAIL_RATIO = _tail_ratio()


class Quadrature(IntEnum):
    """Quadrature rules for a blurred disc: numbers of chords, or the closed form of an edge."""

    CHORDS_4 = 0
    CHORDS_6 = 1
    CHORDS_9 = 2
    CHORDS_14 = 3
    CHORDS_24 = 4
    CHORDS_70 = 5
    EDGE = 6


CHORD_COUNTS = np.array([4, 6, 9, 14, 24, 70])
# Ratio of radius to σ up to which each number of chords is used.
_MAX_RATIOS = np.array([1.6, 2.6, 4.0, 6.2, 10.5, np.inf])
_EDGE_RATIO = 6.0  # of radius to σ, from which the closed form is used


def quadrature_for(radius_over_largest: FloatArray, radius_over_smallest: FloatArray) -> IndexArray:
    """Return the cheapest rules (c,) that are accurate enough; see the module's docstring.

    Parameters
    ----------
    radius_over_largest, radius_over_smallest : (c,) arrays
        Radii of the discs, divided by the largest and by the smallest standard deviation of the
        blur in any direction.
    """
    rules = np.searchsorted(_MAX_RATIOS, radius_over_smallest)
    rules[radius_over_largest > _EDGE_RATIO] = Quadrature.EDGE
    return rules


def _chords(count: int) -> FloatArray:
    """Return positions and half lengths (2, 70) of a unit disc's chords, padded with 0.

    They are at y = sin α for equal steps of α. The integrand is a smooth, periodic function of α
    and vanishes at the ends, so the sum converges exponentially.
    """
    angle = np.pi * np.arange(1, count + 1) / (count + 1) - 0.5 * np.pi
    padded = np.zeros((2, CHORD_COUNTS[-1]))
    padded[:, :count] = np.sin(angle), np.cos(angle)
    return padded


CHORDS = np.array([_chords(count) for count in CHORD_COUNTS])
