"""sRGB's curve between light and grey value, both 0…1 (IEC 61966-2-1)."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray

_LAST_STRAIGHT = 0.0031308  # of the light
_POWER, _SCALE, _OFFSET, _STRAIGHT = 1.0 / 2.4, 1.055, 0.055, 12.92
# of t^(5/3) by the powers of t, to 5e-4 for light of the curved part up to 8
_S0, _S1, _S2, _S3, _S4 = -0.0112011, 0.2053194, 1.0028604, -0.2409779, 0.0444067


def srgb_decoded(level: FloatArray) -> FloatArray:
    """Return linear light from sRGB grey values."""
    bright = ((np.maximum(level, 0.0) + _OFFSET) / _SCALE) ** 2.4
    return np.where(level <= 0.04045, level / _STRAIGHT, bright)


def srgb_encoded(light: FloatArray) -> FloatArray:
    """Return sRGB grey values of linear light."""
    safe = np.maximum(light, _LAST_STRAIGHT)
    bright = _SCALE * safe**_POWER - _OFFSET
    return np.where(light > _LAST_STRAIGHT, bright, _STRAIGHT * light)


def srgb_encoded_number(light: float) -> float:
    """Return what `srgb_encoded` does of one number, without the time that arrays take."""
    if light > _LAST_STRAIGHT:
        return float(_SCALE * light**_POWER - _OFFSET)
    return _STRAIGHT * light


def srgb_slope(light: FloatArray) -> FloatArray:
    """Return the derivative of `srgb_encoded`."""
    safe = np.maximum(light, _LAST_STRAIGHT)
    return np.where(light > _LAST_STRAIGHT, _SCALE * _POWER * safe ** (_POWER - 1.0), _STRAIGHT)


@compiled
def encode_pixels(light: FloatArray, slope: FloatArray) -> FloatArray:
    """Return what `srgb_encoded` does of many pixels (n,), and fill in `srgb_slope` (n,).

    Powers have branches and cannot be vectorised. Here x^(5/12) = y is the cubic root of t⁵, with
    t = x^(1/4): two of Halley's steps from a polynomial, exact to the last digits.
    """
    grey = np.empty(len(light))
    for i in range(len(light)):
        x = max(light[i], _LAST_STRAIGHT)
        t = math.sqrt(math.sqrt(x))
        y, t5 = _S0 + t * (_S1 + t * (_S2 + t * (_S3 + t * _S4))), x * t
        cube = y * y * y
        y *= (cube + 2.0 * t5) / (2.0 * cube + t5)
        cube = y * y * y
        y *= (cube + 2.0 * t5) / (2.0 * cube + t5)
        is_curved = light[i] > _LAST_STRAIGHT
        grey[i] = _SCALE * y - _OFFSET if is_curved else _STRAIGHT * light[i]
        slope[i] = _SCALE * _POWER * y / x if is_curved else _STRAIGHT
    return grey
