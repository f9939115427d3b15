"""sRGB's curve between light and grey value, both 0…1 (IEC 61966-2-1)."""

from __future__ import annotations

import math

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray

_MAX_LINEAR = 0.0031308  # light up to which the curve is linear
_POWER, _SCALE, _OFFSET, _LINEAR_SLOPE = 1.0 / 2.4, 1.055, 0.055, 12.92
# Coefficients of a polynomial in t for t^(5/3), to 5e-4, for light from the curved part up to 8.
_S0, _S1, _S2, _S3, _S4 = -0.0112011, 0.2053194, 1.0028604, -0.2409779, 0.0444067


def srgb_decoded(level: FloatArray) -> FloatArray:
    """Return linear light from sRGB grey values."""
    bright = ((np.maximum(level, 0.0) + _OFFSET) / _SCALE) ** 2.4
    return np.where(level <= 0.04045, level / _LINEAR_SLOPE, bright)


def srgb_encoded(light: FloatArray) -> FloatArray:
    """Return sRGB grey values of linear light."""
    safe = np.maximum(light, _MAX_LINEAR)
    bright = _SCALE * safe**_POWER - _OFFSET
    return np.where(light > _MAX_LINEAR, bright, _LINEAR_SLOPE * light)


def srgb_encoded_number(light: float) -> float:
    """Return the same as `srgb_encoded` for a single number, faster than for an array."""
    if light > _MAX_LINEAR:
        return float(_SCALE * light**_POWER - _OFFSET)
    return _LINEAR_SLOPE * light


def srgb_slope(light: FloatArray) -> FloatArray:
    """Return the derivative of `srgb_encoded`."""
    safe = np.maximum(light, _MAX_LINEAR)
    return np.where(light > _MAX_LINEAR, _SCALE * _POWER * safe ** (_POWER - 1.0), _LINEAR_SLOPE)


@compiled
def encode_pixels(light: FloatArray, slope: FloatArray) -> FloatArray:
    """Return the same as `srgb_encoded` for many pixels (n,), and fill in `srgb_slope` (n,).

    Powers have branches and are not vectorised. Here y = x^(5/12) is the cube root of t⁵ with t =
    x^(1/4): two steps of Halley's method from a polynomial, exact to the last digits.
    """
    grey = np.empty(len(light))
    for i in range(len(light)):
        x = max(light[i], _MAX_LINEAR)
        t = math.sqrt(math.sqrt(x))
        y, t5 = _S0 + t * (_S1 + t * (_S2 + t * (_S3 + t * _S4))), x * t
        cube = y * y * y
        y *= (cube + 2.0 * t5) / (2.0 * cube + t5)
        cube = y * y * y
        y *= (cube + 2.0 * t5) / (2.0 * cube + t5)
        is_curved = light[i] > _MAX_LINEAR
        grey[i] = _SCALE * y - _OFFSET if is_curved else _LINEAR_SLOPE * light[i]
        slope[i] = _SCALE * _POWER * y / x if is_curved else _LINEAR_SLOPE
    return grey
