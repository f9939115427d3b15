"""Rules of integration for blurred discs, and the normal distribution as polynomials.

The radii up to which a rule is used were found by comparing it with the noncentral χ² distribution
(isotropic blur) and with 70 chords (anisotropic): every rule stays below 3e-4 of the contrast.
tests/measurement/image_model/test_blurred_discs.py repeats the comparison.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from scipy.special import erfcx

from kgcp.geometry.arrays import FloatArray, IndexArray

FAR = 6.0  # standard deviations beyond which there is nothing to 1e-9
SQUARINGS = 5  # of exp(−z²/64): so little is left of the range that a short polynomial holds it
BEND = 0.3  # of t = 1 / (1 + BEND z), in which a short polynomial holds Mills' ratio
_EXPONENTIAL_ORDER, _RATIO_ORDER = 6, 7  # 3e-8 together


def _fitted(x: FloatArray, y: FloatArray, order: int) -> tuple[float, ...]:
    """Return the coefficients, the constant first."""
    return tuple(Chebyshev.fit(x, y, order).convert(kind=Polynomial).coef.tolist())


def _exponential() -> tuple[float, ...]:
    """Return exp(−q), q = z²/2 / 2**SQUARINGS, as far as z = FAR."""
    q = np.linspace(0.0, 0.5 * FAR**2 / 2**SQUARINGS, 2001)
    return _fitted(q, np.exp(-q), _EXPONENTIAL_ORDER)


def _tail_ratio() -> tuple[float, ...]:
    """Return Mills' ratio by t, from z = 0 to FAR."""
    low = 1.0 / (1.0 + BEND * FAR)
    t = 0.5 * (1.0 + low) + 0.5 * (1.0 - low) * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    ratio = math.sqrt(0.5 * math.pi) * erfcx((1.0 / t - 1.0) / BEND * math.sqrt(0.5))
    return _fitted(t, ratio, _RATIO_ORDER)


EXPONENTIAL = _exponential()
TAIL_RATIO = _tail_ratio()


class Quadrature(IntEnum):
    """Rules of integration, cheapest that holds 3e-4 of the contrast.

    `EDGE` integrates nothing: it is the closed form.
    """

    CHORDS_4 = 0
    CHORDS_6 = 1
    CHORDS_9 = 2
    CHORDS_14 = 3
    CHORDS_24 = 4
    CHORDS_70 = 5
    EDGE = 6


CHORD_COUNTS = np.array([4, 6, 9, 14, 24, 70])
_LARGEST_RATIOS = np.array([1.6, 2.6, 4.0, 6.2, 10.5, np.inf])  # of the radius to σ
_STRAIGHT_RATIO = 6.0


def quadrature_for(radius_over_whole: FloatArray, radius_over_sigma: FloatArray) -> IndexArray:
    """Return the cheapest rules (c,) whose error stays below 3e-4 of the contrast.

    Parameters
    ----------
    radius_over_whole, radius_over_sigma : (c,) arrays
        Radii of discs, by the largest standard deviation in any direction and the smallest.
    """
    by_chords = np.searchsorted(_LARGEST_RATIOS, radius_over_sigma)
    by_chords[radius_over_whole > _STRAIGHT_RATIO] = Quadrature.EDGE
    return by_chords


def _chords(count: int) -> FloatArray:
    """Return positions and half lengths (2, 70) of a unit disc's chords at equal steps of angle.

    With y = r sin α the integrand is smooth and periodic in α and vanishes at the ends, so equal
    steps converge exponentially.
    """
    angle = np.pi * np.arange(1, count + 1) / (count + 1) - 0.5 * np.pi
    padded = np.zeros((2, CHORD_COUNTS[-1]))
    padded[:, :count] = np.sin(angle), np.cos(angle)
    return padded


CHORDS = np.array([_chords(count) for count in CHORD_COUNTS])
