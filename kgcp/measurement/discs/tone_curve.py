"""The tone curve of a camera, over the whole range of grey values.

All discs of all photographs share it, whatever their levels. It is a known curve, sRGB's or a
straight line, whose grey value y is bent by three waves:

    grey = y + Σ tₖ sin(kπy) / kπ,  k = 1, 2, 3

Black stays black and white stays white, and tₖ is the amplitude of the change of slope. The first
wave acts like a gamma, the second is the S that cameras add for contrast (trigonometric response
models: Grossberg & Nayar, "What is the space of camera response functions?", CVPR 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.srgb import srgb_decoded, srgb_encoded

WAVES = 3
_LEAST_SLOPE = 0.35  # of the bent curve relative to the known one
_DARKEST, _BRIGHTEST = 0.05, 0.95  # grey values between which that is required
# Least first wave, for sRGB's curve and for a straight line: no camera makes its darks darker than
# they are, except by an error of the black level. (At -0.95, sRGB's curve would be nearly a
# straight line.) The limit for sRGB matters only beside a positive second wave; without one,
# `_LEAST_SLOPE` stops the first wave at -0.66.
_LEAST_GAMMA = (-0.8, -0.15)
_NEWTON_STEPS = 20


@dataclass(frozen=True, slots=True)
class DiscTone:
    """The relation of light, 1 at full scale, to grey value before clipping.

    Attributes
    ----------
    tone : Tone
        Which known curve it is, and whether it may be bent.
    waves : (3,) tuple of float
        Amplitudes of the waves; zeros: it is not bent.
    """

    tone: Tone
    waves: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def bent(self, waves: FloatArray) -> DiscTone:
        """Return the curve with other amplitudes (3,)."""
        first, second, third = waves.tolist()
        return replace(self, waves=(first, second, third))

    def levels(self, light: FloatArray) -> FloatArray:
        """Return grey values (n,) of light (n,)."""
        known = srgb_encoded(light) if self.tone.is_srgb else light
        return bend(known, np.array(self.waves))

    def light(self, levels: FloatArray) -> FloatArray:
        """Return the light (n,) of grey values (n,)."""
        known = _straightened(levels, np.array(self.waves))
        return srgb_decoded(known) if self.tone.is_srgb else known


def plausible(waves: FloatArray, tone: Tone) -> FloatArray:
    """Return the amplitudes (3,), limited to those of a curve that a camera can have.

    The first wave has a lower limit because the skirts of a point spread imitate a curve that makes
    darks darker: they scatter light from the ground onto a disc, more of it near the edge.
    """
    waves = waves.copy()
    waves[0] = max(waves[0], _least_gamma(tone))
    return steep_enough(waves)


def _least_gamma(tone: Tone) -> float:
    return _LEAST_GAMMA[0 if tone.is_srgb else 1]


def steep_enough(waves: FloatArray) -> FloatArray:
    """Return the amplitudes (3,), reduced until the curve is steep enough everywhere.

    Where a curve is flat, a gradient of the light does not show on the ground, however large it is.
    The fit would then use such a gradient to explain anything that makes opposite edges differ, for
    example coma.
    """
    steepest_fall = -float((waves @ _slopes_of_waves()).min())
    most = 1.0 - _LEAST_SLOPE
    return waves * (most / steepest_fall) if steepest_fall > most else waves


def wave_limits(tone: Tone) -> tuple[FloatArray, FloatArray]:
    """Return the limits of `plausible`: rows (m, 3), and their least products (m,) with waves."""
    slopes = _slopes_of_waves().T
    rows = np.vstack((slopes, (1.0, 0.0, 0.0)))
    least = np.full(len(rows), _LEAST_SLOPE - 1.0)
    least[-1] = _least_gamma(tone)
    return rows, least


@cache
def _slopes_of_waves() -> FloatArray:
    places = np.linspace(_DARKEST, _BRIGHTEST, 33)
    return np.cos(np.pi * np.arange(1, WAVES + 1)[:, None] * places)


@compiled
def bend(known: FloatArray, waves: FloatArray) -> FloatArray:
    """Return the grey values of a known curve after bending; a straight line beyond 0…1."""
    level = np.empty(len(known))
    for i in range(len(known)):
        within = min(max(known[i], 0.0), 1.0)
        bent, slope = within, 1.0
        for k in range(len(waves)):
            turn = np.pi * (k + 1.0)
            bent += waves[k] * np.sin(turn * within) / turn
            slope += waves[k] * np.cos(turn * within)
        level[i] = bent + slope * (known[i] - within)
    return level


@compiled
def _straightened(levels: FloatArray, waves: FloatArray) -> FloatArray:
    """Return the inverse of `bend`, by Newton's method within 0…1."""
    known = np.empty(len(levels))
    for i in range(len(levels)):
        low, high, at = 0.0, 1.0, min(max(levels[i], 0.0), 1.0)
        for _ in range(_NEWTON_STEPS):
            bent, slope = at, 1.0
            for k in range(len(waves)):
                turn = np.pi * (k + 1.0)
                bent += waves[k] * np.sin(turn * at) / turn
                slope += waves[k] * np.cos(turn * at)
            low, high = (at, high) if bent < levels[i] else (low, at)
            step = (levels[i] - bent) / slope
            if levels[i] <= 0.0 or levels[i] >= 1.0:  # where the curve is a straight line
                at += step
                break
            at = at + step if low <= at + step <= high else 0.5 * (low + high)
            if abs(step) < 1e-13:
                break
        known[i] = at
    return known
