"""The chance that a ring with random light on it is taken for a target's."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.records import Measurement
from kgcp.measurement.search.code_signal import reference_signals
from kgcp.targets.layout import Ring, Target

RINGS_PER_FRAME = 1e-3
"""Rings of a target's shape that a frame of rich texture shows by chance, dots apart."""


def code_chance(score: float, ring: Ring, blur_rad: float) -> float:
    """Return the chance that random light on a ring's code circle scores as high as its code.

    The light is Gaussian noise, blurred as the frame is, with power λ_k = exp(−k² σ²) at frequency
    k. The code has the share p_k of its power there; its correlation with such noise has the
    variance 1/m = Σ p λ / 2 Σ λ, as if the noise were a random direction in m dimensions. Over all
    headings the code is a closed curve on the sphere of directions. The chance to come as near to
    it as arccos(score) is at most that of its tube (Hotelling 1939, Naiman 1986),

        κ (1 − score²)^(m/2 − 1),        κ² = Σ k² p λ / Σ p λ        (length of the curve / 2π)

    The degrees of blur that the code is tried with have a tube each, and these are added up.

    Parameters
    ----------
    score : float
        Normalised cross-correlation of the code, best over headings and degrees of blur.
    blur_rad : float
        σ of the edges as an angle along the code circle [rad].
    """
    power = _power(ring)
    square = np.arange(1, power.shape[1] + 1) ** 2
    noise = np.exp(-blur_rad * blur_rad * square)
    shared = power @ noise
    dimensions = 2.0 * noise.sum() / shared
    lengths = np.sqrt(power @ (square * noise) / shared)
    unlike = max(0.0, 1.0 - score * score)
    return min(1.0, float(np.sum(lengths * unlike ** (0.5 * dimensions - 1.0))))


@lru_cache(maxsize=64)
def _power(ring: Ring) -> FloatArray:
    """Return the code's share of power by blur and frequency, from the lowest on."""
    power = np.abs(np.fft.rfft(reference_signals(ring)))[:, 1:] ** 2
    return np.asarray(power / power.sum(axis=1, keepdims=True))


def check_chance(measurement: Measurement, target: Target, ring: Ring, false_alarm: float) -> None:
    """Refuse a code that a frame may show by chance; without a blur estimate nothing is refused.

    Parameters
    ----------
    ring : Ring
        The ring of the target whose code was found.
    false_alarm : float
        Chance per frame that is accepted.

    Raises
    ------
    Rejection
        `CODE_MISMATCH`.
    """
    appearance = measurement.appearance
    if appearance.blur_px is None:
        return
    code_radius_px = appearance.radius_px * ring.code_diameter_m / target.ring.outer_diameter_m
    chance = code_chance(measurement.score, ring, appearance.blur_px / code_radius_px)
    if RINGS_PER_FRAME * chance > false_alarm:
        raise Rejection(
            Reason.CODE_MISMATCH,
            f"score {measurement.score:.2f} comes about by chance in {RINGS_PER_FRAME * chance:.0e}"
            f" of all frames, allowed are {false_alarm:.0e}",
        )
