"""Rings in uneven light: their grey values as they would be in even light."""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.templates import ANGLES, edge_rows
from kgcp.targets.layout import Ring

SMALLEST_UNEVEN_PX = 12.5
"""Radius below which rings hardly show ink and plate beside their edges: their light is even."""
_INK_RANK = 0.35  # of grey values near an angle: dots that blur spreads are brighter than ink
_HALF_INK, _HALF_PLATE = 10, 5  # samples to either side: more than a dot, less than a shadow
_SMOOTHED = 3.0  # samples
_UNEVEN = 0.15  # of the contrast: below, one pair of levels does
_LEAST_CONTRAST = 0.2  # of the typical one: what is fainter is something else


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
    white_out, white_in = (_around(patch[r], 0.5, _HALF_PLATE) for r in (plate, disc))
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


def _around(values: FloatArray, rank: float, half: int) -> FloatArray:
    """Return a running quantile of values (angles,) on a circle, smoothed."""
    steps = np.arange(-half, half + 1)
    near = np.quantile(values[(np.arange(ANGLES)[:, None] + steps) % ANGLES], rank, axis=1)
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / _SMOOTHED) ** 2)
    kernel /= kernel.sum()
    return np.asarray(near[(np.arange(ANGLES)[:, None] + reach) % ANGLES] @ kernel)
