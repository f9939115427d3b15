"""Rings in uneven light: their grey values as they would be in even light."""

from __future__ import annotations

from functools import cache

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.measurement.search.templates import ANGLES, edge_rows
from kgcp.targets.layout import Ring

SMALLEST_EVENED_PX = 8.0
"""Radius below which no levels are read beside edges: the light of such rings is even."""
# samples to either side of an angle: more than a dot, less than a shadow
_HALF_INK, _HALF_PLATE = 10, 5
# which of them is the level, by size: the plate's is the median; dots that blur spreads are
# brighter than ink
_INK_RANK, _PLATE_RANK = 7, 5
_SMOOTHED = 3.0  # samples
_REACH = 8  # samples that it reaches to either side
_KERNEL = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _SMOOTHED) ** 2)
_KERNEL /= _KERNEL.sum()
_UNEVEN = 0.15  # of the contrast: below, one pair of levels does
_LEAST_CONTRAST = 0.2  # of the typical one: anything fainter is something else


def evened_patch(patch: FloatArray, ring: Ring, shift: int) -> FloatArray | None:
    """Return a polar patch as it would be if ink and plate had the same levels at all angles.

    They are read on either side of both edges, smoothed around the ring, and between the edges
    taken to change evenly: so much smoother than a code's dots that they cannot make one. None if
    the levels are even, or if a part does not look like a ring.

    Parameters
    ----------
    patch : (rows + 2 shifts, angles) array
        Sampled at `SAMPLED_RADII`.
    shift : int
        Of the template that fits best.
    """
    plate, outside, disc, inside = (row + shift for row in edge_rows(ring))
    white_out, white_in = (_around(patch[r], _PLATE_RANK, _HALF_PLATE) for r in (plate, disc))
    black_out, black_in = (_around(patch[r], _INK_RANK, _HALF_INK) for r in (outside, inside))
    steps = np.stack((white_out - black_out, white_in - black_in))
    typical = float(np.median(steps))
    if typical <= 0.0 or steps.min() < _LEAST_CONTRAST * typical:
        return None
    varied = max(float(np.ptp(level)) for level in (white_out, white_in, black_out, black_in))
    if varied < _UNEVEN * typical:
        return None
    rows = np.arange(len(patch))[:, None]
    share = np.clip((rows - inside) / (outside - inside), 0.0, 1.0)
    black = black_in + share * (black_out - black_in)
    share = np.clip((rows - disc) / (plate - disc), 0.0, 1.0)
    white = white_in + share * (white_out - white_in)
    contrast = np.maximum(white - black, _LEAST_CONTRAST * typical)
    middle = float(np.median(black))
    return np.asarray(middle + typical * (patch - black) / contrast)


def _around(values: FloatArray, rank: int, half: int) -> FloatArray:
    """Return the value of a rank among those near, at all angles of a circle, smoothed."""
    near = values[_near(half)]
    near.partition(rank, axis=1)
    return np.asarray(near[:, rank][_near(_REACH)] @ _KERNEL)


@cache
def _near(half: int) -> IndexArray:
    """Return the indices (angles, 2 half + 1) of the samples near every angle."""
    return (np.arange(ANGLES)[:, None] + np.arange(-half, half + 1)) % ANGLES
