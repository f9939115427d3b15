"""Polynomials for the normal distribution: fitted here, evaluated in compiled loops.

An exponential or an error function of a library is called for one number at a time; polynomials
are worked out for several at once. exp(−z²/2) is the 32nd power of one in z². The tail is the
density times Mills' ratio, which is nearly a polynomial in t = 1/(1 + BEND z).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from scipy.special import erfcx

from kgcp.geometry.arrays import FloatArray

FAR = 6.0  # standard deviations beyond which there is nothing to 1e-9
SQUARINGS = 5
BEND = 0.3
_EXPONENTIAL_ORDER, _RATIO_ORDER = 6, 7


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
