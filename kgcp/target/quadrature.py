"""Rules of integration for blurred discs.

A white disc of radius r, blurred by a Gaussian, has at distance ρ from its centre the level
P(|ρ + ε| ≤ r): for isotropic blur the distribution function of a noncentral χ² with two degrees of
freedom, 1 − Q₁(ρ/σ, r/σ) with Marcum's Q. On a tilted plate the blur is anisotropic, so the
probability is integrated directly: over the chords of the disc in some direction, with the inner
integral (along that direction, conditioned on the one across) in closed form. Where the disc is
large against the blur its edge is nearly straight within the blur, and has a closed form.

A streak of uniform motion is part of the inner integral, for chords along the streak. They must be
as close as the blur across it asks for, be the streak ever so long.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray


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
