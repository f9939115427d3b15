"""The probability that a ring with random light on it is taken for a target."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.records import Measurement
from kgcp.measurement.search.code_signal import reference_signals
from kgcp.targets.layout import Ring, Target

CHANCE_RINGS_PER_FRAME = 1e-3
"""Expected number of rings in a frame of rich texture that have a target's shape by chance.

The dots are not considered here.
"""


def false_code_probability(score: float, ring: Ring, blur_rad: float) -> float:
    """Return an upper bound of the probability that random light scores as high as a code.

    The random light on the code circle is modelled as Gaussian noise with the frame's blur: its
    power at frequency k is λ_k = exp(−k² σ²). Let p_k be the code's share of power at k. The
    correlation of the code with such noise has the variance 1/m = Σ p λ / 2 Σ λ, as if the noise
    were a random direction in m dimensions.

    Over all headings, the code is a closed curve on the sphere of directions. The probability that
    a random direction comes within the angle arccos(score) of the curve is at most that of a tube
    around it (Hotelling 1939, Naiman 1986):

        κ (1 − score²)^(m/2 − 1),        κ² = Σ k² p λ / Σ p λ        (length of the curve / 2π)

    The code is tried with several blurs. The probabilities of their tubes are added.

    Parameters
    ----------
    score : float
        Normalised cross-correlation of the code, the best over headings and blurs.
    blur_rad : float
        σ of the edges, as an angle along the code circle [rad].
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
    """Return the code's shares of power (blurs, frequencies), from frequency 1 on."""
    power = np.abs(np.fft.rfft(reference_signals(ring)))[:, 1:] ** 2
    return np.asarray(power / power.sum(axis=1, keepdims=True))


def check_false_alarm(
    measurement: Measurement, target: Target, ring: Ring, false_alarm: float
) -> None:
    """Reject a code that a frame may show by chance; without a blur estimate nothing is rejected.

    Parameters
    ----------
    ring : Ring
        The ring of the target whose code was found.
    false_alarm : float
        Accepted probability per frame.

    Raises
    ------
    Rejection
        `CODE_MISMATCH`.
    """
    appearance = measurement.appearance
    if appearance.blur_px is None:
        return
    code_radius_px = appearance.radius_px * ring.code_diameter_m / target.ring.outer_diameter_m
    chance = false_code_probability(measurement.score, ring, appearance.blur_px / code_radius_px)
    if CHANCE_RINGS_PER_FRAME * chance > false_alarm:
        raise Rejection(
            Reason.CODE_MISMATCH,
            f"score {measurement.score:.2f} occurs by chance in"
            f" {CHANCE_RINGS_PER_FRAME * chance:.0e} of all frames, limit {false_alarm:.0e}",
        )
