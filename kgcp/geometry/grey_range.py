"""The range of a frame's grey values."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import GreyArray

_BRIGHTEST_QUANTILE = 0.999


def full_scale(grey: GreyArray) -> float:
    """Return the largest grey value that the data type can hold; 1 for floats."""
    return float(np.iinfo(grey.dtype).max) if np.issubdtype(grey.dtype, np.integer) else 1.0


def brightest_level(grey: GreyArray) -> float:
    """Return the grey value that counts as white in a frame.

    For 16 bits it is a quantile near the brightest pixels, because such frames often hold only 10
    or 12 bits. Otherwise it is full scale.
    """
    if grey.dtype != np.uint16:
        return full_scale(grey)
    return max(float(np.quantile(grey[::4, ::4], _BRIGHTEST_QUANTILE)), 1.0)
