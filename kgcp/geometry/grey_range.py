"""Which part of its data type's range a frame's grey values take."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import GreyArray

_BRIGHTEST_QUANTILE = 0.999


def full_scale(grey: GreyArray) -> float:
    """Return the largest grey value of the data type; 1 for floats."""
    return float(np.iinfo(grey.dtype).max) if np.issubdtype(grey.dtype, np.integer) else 1.0


def brightest_level(grey: GreyArray) -> float:
    """Return what counts as white in a frame: the end of 8 bits, or its own brightest pixels.

    A 16-bit frame often holds 10 or 12 bits, so that a share of its data type's range means little.
    """
    if grey.dtype != np.uint16:
        return full_scale(grey)
    return max(float(np.quantile(grey[::4, ::4], _BRIGHTEST_QUANTILE)), 1.0)
