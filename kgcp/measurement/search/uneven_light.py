"""Rings in uneven light: their grey values as they would be in even light."""

from __future__ import annotations

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.search.templates import edge_rows
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
    whites = _around(patch[[plate, disc]], _PLATE_RANK, _HALF_PLATE)
    blacks = _around(patch[[outside, inside]], _INK_RANK, _HALF_INK)
    steps = whites - blacks
    typical = _median(steps.ravel())
    if typical <= 0.0 or steps.min() < _LEAST_CONTRAST * typical:
        return None
    if max(np.ptp(whites, axis=1).max(), np.ptp(blacks, axis=1).max()) < _UNEVEN * typical:
        return None
    (white_out, white_in), (black_out, black_in) = whites, blacks
    rows = np.arange(len(patch))[:, None]
    share = np.clip((rows - inside) / (outside - inside), 0.0, 1.0)
    black = black_in + share * (black_out - black_in)
    share = np.clip((rows - disc) / (plate - disc), 0.0, 1.0)
    white = white_in + share * (white_out - white_in)
    contrast = np.maximum(white - black, _LEAST_CONTRAST * typical)
    middle = _median(black.ravel())
    return np.asarray(middle + typical * (patch - black) / contrast)


def _median(values: FloatArray) -> float:
    """Return the median of an even number of values, faster than numpy, which checks for NaN."""
    half = len(values) // 2
    ordered = np.partition(values, (half - 1, half))
    return 0.5 * float(ordered[half - 1] + ordered[half])


def _around(circles: FloatArray, rank: int, half: int) -> FloatArray:
    """Return the values of a rank among those near, at all angles of circles, smoothed.

    `circles` (n, angles) are values at equal angles; those to `half` on either side are near.
    """
    levels, smoothed = np.empty(circles.shape), np.empty(circles.shape)
    _fill_in_ranked(_closed(circles, half), rank, half, levels)
    _smooth(_closed(levels, _REACH), _KERNEL, smoothed)
    return smoothed


def _closed(circles: FloatArray, reach: int) -> FloatArray:
    """Append the last values of circles before the first ones, and the first after the last."""
    return np.concatenate((circles[:, -reach:], circles, circles[:, :reach]), axis=1)


@compiled
def _fill_in_ranked(closed: FloatArray, rank: int, half: int, out: FloatArray) -> None:
    """Fill in the value of a rank, from 0, among those near.

    It is the largest that at most so many others are less than: a few hundred comparisons in vector
    units, at all angles, take less time than to put so few values in order.
    """
    angles, width = out.shape[1], 2 * half + 1
    less = np.empty(angles)
    for i in range(len(out)):
        circle, ranked = closed[i], out[i]
        ranked[:] = -np.inf
        for k in range(width):
            less[:] = 0.0
            for j in range(width):
                for a in range(angles):
                    less[a] += 1.0 if circle[a + j] < circle[a + k] else 0.0
            for a in range(angles):
                if less[a] <= rank and circle[a + k] > ranked[a]:
                    ranked[a] = circle[a + k]


@compiled
def _smooth(closed: FloatArray, kernel: FloatArray, out: FloatArray) -> None:
    """Fill in weighted means of the values near."""
    for i in range(len(out)):
        circle, smoothed = closed[i], out[i]
        smoothed[:] = 0.0
        for k in range(len(kernel)):
            for a in range(len(smoothed)):
                smoothed[a] += kernel[k] * circle[a + k]
